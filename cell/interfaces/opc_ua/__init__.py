"""OPC UA, extra ``opcua``: `interface` has nodes and methods, `server` the rights of clients."""
