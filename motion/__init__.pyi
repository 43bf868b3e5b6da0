from .axes import Axes as Axes, Axis as Axis, AxisSettings as AxisSettings, Watch as Watch
from .drive import Cia402Drive as Cia402Drive, DriveBus as DriveBus, DriveSettings as DriveSettings
from .errors import MotionError as MotionError
from .servo import ServoAxis as ServoAxis, ServoAxisSettings as ServoAxisSettings
