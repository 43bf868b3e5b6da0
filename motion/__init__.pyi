from .axes import Axes as Axes
from .axis import Axis as Axis, AxisSettings as AxisSettings
from .bus import DriveBus as DriveBus, Watch as Watch
from .drive import Cia402Drive as Cia402Drive, DriveSettings as DriveSettings
from .errors import MotionError as MotionError
from .servo import ServoAxis as ServoAxis, ServoAxisSettings as ServoAxisSettings
