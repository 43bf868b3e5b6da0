"""Modbus TCP: the interface for PLCs. `protocol` is the codec and server, `registers` the map."""
