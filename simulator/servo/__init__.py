"""Simulated DYNAMIXEL servos and the fingers that they move, for the cell and for tests of drivers.

`bus` is the half-duplex line with the host's end in memory; `device` is a servo as Protocol 2.0
device (`protocol2`, `control_table`) with its `firmware`; `motor`, `gearing` and `mechanics` are
the physics, `faults` the knobs of the line, `wrist` is a servo of an axis.
"""
