"""The interfaces of a cell: command line, Modbus TCP, XML-RPC, HTTP with the page, OPC UA, wizard.

`opening` opens those that the config names. `host_calls` and `host_values` are the tables that
Modbus, XML-RPC and OPC UA are made of. `access` checks who may connect.
"""
