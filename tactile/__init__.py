"""The tactile sensor: taxels, CAN transport, node supervision, force; no servos, no objects.

`open_sensor` opens the control unit's bus; a program that measures needs only the names below.
Sub-packages are `sensor` (counts to newtons, tare), `control_unit` (the CANopen node), `uskin`
(boards on CAN) and `can` (the bus). Modules are `layout`, `source`, `frames` (messages of the
control unit), `flexitac` (boards on serial ports), `board_source`, `clock` and `errors`.
"""

import lazy_loader

# The names stand in __init__.pyi. A module is imported at the first use of one of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
