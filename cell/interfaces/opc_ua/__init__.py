"""OPC UA, extra ``opcua``: for `serving`, `door.OpcUaDoor`; inside, `server`: who may do what."""
