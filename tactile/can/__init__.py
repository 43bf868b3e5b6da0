"""CAN buses for the links to CANopen nodes: opened, locked, supervised.

`bus` opens an interface of python-can and corrects errors of its drivers. It has the sources of
received messages, including the thread that stamps them. `sdo_client` reads and writes the objects
of a CANopen node.
"""
