"""A force-controlled two-finger gripper on DYNAMIXEL X servos; no taxels, no objects.

`open_gripper` opens the servos' port; the names below are all that a program needs to move a
gripper. Sub-packages: `force` (ramps and the force loop), `servos` (the servos of one gripper as a
group), `mechanics` (linkage, friction, impact), `dynamixel` (Protocol 2.0 on a serial line; the
only importer of `serial` and the SDK), `values` (reports and results); beside them
`gripper`, `lifecycle`, `settings`, `clock` and `errors`.
"""

import lazy_loader

# The names stand in __init__.pyi. A module is imported at the first use of one of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
