"""The interfaces of a cell: command line, Modbus TCP, XML-RPC, HTTP with the page.

`opening` opens those that the config names. `access` checks who may connect.
"""
