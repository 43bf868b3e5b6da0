"""Modbus TCP: the door for PLCs. `protocol` is the codec and server, `registers` the map."""
