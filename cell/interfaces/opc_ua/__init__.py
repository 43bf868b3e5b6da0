"""OPC UA, extra ``opcua``: `interface` is the interface, `server` checks the rights of clients."""
