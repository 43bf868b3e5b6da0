"""Axes that move the object between two grasps: CiA 402 drives and one Dynamixel wrist.

A program moves axes with `Axes` and an `Axis` for each, in m and rad.
`drive` is one CiA 402 drive on a CAN bus (`bus`), `servo` one Dynamixel servo in extended position
mode; both count in increments. `object_dictionary` names the objects of a drive (``drive.eds``),
and `errors` has all errors. This package does not use the fingers.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from motion.axes import Axes as Axes, Axis as Axis, AxisDevice as AxisDevice
    from motion.bus import DriveBus as DriveBus, Watch as Watch
    from motion.drive import Cia402Drive as Cia402Drive, DriveSettings as DriveSettings
    from motion.errors import MotionError as MotionError
    from motion.servo import ServoAxis as ServoAxis, ServoAxisSettings as ServoAxisSettings

_FACE = {
    "motion.axes": "Axes Axis AxisDevice",
    "motion.bus": "DriveBus Watch",
    "motion.drive": "Cia402Drive DriveSettings",
    "motion.errors": "MotionError",
    "motion.servo": "ServoAxis ServoAxisSettings",
}
"""Names by module; a module is imported at the first use of one of its names."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
