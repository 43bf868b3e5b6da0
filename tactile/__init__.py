"""The tactile sensor: taxels, CAN transport, node supervision, force; no servos, no objects.

`open_sensor` opens the control unit's bus; a program that measures needs only the names below.
Sub-packages are `sensor` (counts to newtons, tare), `control_unit` (the CANopen node), `flexitac`
and `uskin` (boards on serial ports), `frames` (complete frames and force messages) and `can` (the
bus). Modules are `layout`, `source`, `board_source`, `clock` and `errors`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tactile.control_unit.settings import LinkSettings as LinkSettings
    from tactile.errors import TactileError as TactileError
    from tactile.layout import (
        Pad as Pad,
        TaxelLayout as TaxelLayout,
        paper_layout as paper_layout,
        pinch_layout as pinch_layout,
    )
    from tactile.sensor.calibration import (
        Calibration as Calibration,
        FoamCalibration as FoamCalibration,
        LinearCalibration as LinearCalibration,
    )
    from tactile.sensor.grip_force import GripForce as GripForce
    from tactile.sensor.opening import open_sensor as open_sensor
    from tactile.sensor.sensor import (
        SensorSettings as SensorSettings,
        TactileReading as TactileReading,
        TactileSensor as TactileSensor,
    )
    from tactile.sensor.tare import TareResult as TareResult
    from tactile.source import FrameSource as FrameSource, TactileFrame as TactileFrame

_FACE = {
    "tactile.errors": "TactileError",
    "tactile.source": "FrameSource TactileFrame",
    "tactile.layout": "Pad TaxelLayout paper_layout pinch_layout",
    "tactile.sensor.calibration": "Calibration FoamCalibration LinearCalibration",
    "tactile.sensor.grip_force": "GripForce",
    "tactile.sensor.opening": "open_sensor",
    "tactile.sensor.sensor": "SensorSettings TactileReading TactileSensor",
    "tactile.sensor.tare": "TareResult",
    "tactile.control_unit.settings": "LinkSettings",
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
