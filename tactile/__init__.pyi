from .control_unit.settings import LinkSettings as LinkSettings
from .errors import TactileError as TactileError
from .layout import (
    Pad as Pad,
    TaxelLayout as TaxelLayout,
    paper_layout as paper_layout,
    pinch_layout as pinch_layout,
)
from .sensor.calibration import (
    Calibration as Calibration,
    FoamCalibration as FoamCalibration,
    TableCalibration as TableCalibration,
)
from .sensor.grip_force import GripForce as GripForce
from .sensor.opening import open_sensor as open_sensor
from .sensor.sensor import TactileReading as TactileReading, TactileSensor as TactileSensor
from .sensor.settings import SensorSettings as SensorSettings
from .sensor.tare import TareResult as TareResult
from .source import FrameSource as FrameSource, TactileFrame as TactileFrame
