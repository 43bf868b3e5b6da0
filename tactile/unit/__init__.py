"""The control unit as a CANopen node, for the cell.

`link` is where to start: it starts the unit and hands out frames. Its parts are `session`, `sdo`,
`commissioning` and `supervision`; `settings` are its periods and limits; `object_dictionary` names
the unit's objects (``control_unit.eds``).
"""
