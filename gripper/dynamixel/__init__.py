"""DYNAMIXEL Protocol 2.0 on a serial line: only this package imports `serial`.

For the servo group: `bus.ServoBus` (read and write registers of several servos), `control_table`
and `models` (registers and data of each servo model). Inside: `protocol2` (packets),
`serial_port`, `latency` (check of the round trips).
"""
