"""The simulated control unit on its CAN bus, for the simulated cell and for tests of the link.

`control_unit` is the CANopen device, `scanner` has the bytes of its messages. `link` leads to the
host's adapter: python-can's interface in virtual time, or a serial adapter (`slcan`). `faults` are
the knobs of device and link.
"""
