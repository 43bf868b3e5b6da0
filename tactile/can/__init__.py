"""CAN buses, for the control unit's link: opened, locked, supervised.

`bus` opens an interface of python-can and closes the traps of its drivers; `receiver` has the
sources of received messages, among them the one thread that stamps them.
"""
