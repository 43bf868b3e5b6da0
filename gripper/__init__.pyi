from .errors import GripperError as GripperError
from .force.ramp import ForceRamp as ForceRamp
from .gripper import Gripper as Gripper, open_gripper as open_gripper
from .mechanics.kinematics import (
    Linkage as Linkage,
    ParallelLinkage as ParallelLinkage,
    RackPinion as RackPinion,
)
from .settings import GripperSettings as GripperSettings, ServoSettings as ServoSettings
from .values.force_sensor import ForceSample as ForceSample, ForceSensor as ForceSensor
from .values.outcome import GraspOutcome as GraspOutcome, GraspResult as GraspResult
from .values.state import (
    Cycle as Cycle,
    GripperPhase as GripperPhase,
    ServoFeedback as ServoFeedback,
)
