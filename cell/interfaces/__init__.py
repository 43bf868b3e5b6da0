"""Who asks a cell for something.

`cli` is the command line, `plugin` the cell in a host's own process, `service` the resident cell
behind the doors `modbus`, `xml_rpc`, `web` and `opc_ua`.
"""
