"""The interfaces of a cell: command line, Modbus TCP, XML-RPC, HTTP with the page.

`opening` opens those that the config names. `host_calls` and `host_values` are the tables that
Modbus and XML-RPC are made of. `access` checks who may connect.
"""
