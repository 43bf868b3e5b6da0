"""The control unit as a CANopen node, for the cell.

`link` is the entry: it starts the unit and returns frames. Its parts are `session`, `sdo`,
`commissioning` and `supervision`. `settings` has its periods and limits, and `object_dictionary`
the unit's objects (``control_unit.eds``).
"""
