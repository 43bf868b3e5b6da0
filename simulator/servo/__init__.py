"""Simulated DYNAMIXEL servos and the fingers that they move, for the cell and for tests of drivers.

`bus` is the half-duplex line and the host's end of it in memory; `device` is a servo as Protocol
2.0 device (`protocol2`, `control_table`), `firmware` what it does by itself, `motor`,
`gearing` and `mechanics` the physics, `faults` the knobs of the line.
"""
