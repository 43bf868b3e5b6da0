"""Modbus TCP: the interface for PLCs. `protocol`: codec and server, `registers`: register map."""
