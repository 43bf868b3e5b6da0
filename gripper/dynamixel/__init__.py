"""DYNAMIXEL Protocol 2.0 on a serial line: only this package imports `serial` and the SDK.

For the servo group: `bus.ServoBus` (read and write registers of several servos), `control_table`
and `models` (registers and data of each servo model). Inside: `serial_port`, `protocol2`,
`latency` (check of the round trips).
"""
