"""The control unit as a CANopen node, for the cell.

`node` is the entry: it starts the unit and returns frames. `setup` checks the unit and writes its
objects, `watch` supervises it, and `search` finds an unknown unit. `settings` has periods and
limits, `object_dictionary` the unit's objects (``control_unit.eds``).
"""
