"""Axes that move the object between two grasps: CiA 402 drives and one Dynamixel wrist.

A program moves axes with `Axes` and an `Axis` for each, in m and rad.
`drive` has CiA 402 drives on a CAN bus, `servo` one Dynamixel servo in extended position mode; both
count in increments. `object_dictionary` names the objects of a drive (``drive.eds``),
and `errors` has all errors. This package does not use the fingers.
"""

import lazy_loader

# The names stand in __init__.pyi. A module is imported at the first use of one of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
