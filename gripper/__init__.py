"""A force-controlled two-finger gripper on DYNAMIXEL X servos; no taxels, no objects.

`open_gripper` opens the servos' port; the names below are all that a program needs to move a
gripper. Sub-packages: `force` (ramps and the force loop), `servos` (the servos of one gripper as a
group), `mechanics` (linkage, friction, impact), `dynamixel` (Protocol 2.0 on a serial line; the
only importer of `serial` and the SDK), `values` (reports and results); beside them
`gripper`, `lifecycle`, `settings`, `clock` and `errors`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gripper.errors import GripperError as GripperError
    from gripper.force.ramp import ForceRamp as ForceRamp
    from gripper.gripper import Gripper as Gripper, open_gripper as open_gripper
    from gripper.mechanics.kinematics import (
        Linkage as Linkage,
        ParallelLinkage as ParallelLinkage,
        RackPinion as RackPinion,
    )
    from gripper.settings import (
        ForceLoopSettings as ForceLoopSettings,
        GripperSettings as GripperSettings,
        OverForce as OverForce,
        ServoSettings as ServoSettings,
    )
    from gripper.values.force_sensor import ForceSample as ForceSample, ForceSensor as ForceSensor
    from gripper.values.outcome import GraspOutcome as GraspOutcome, GraspResult as GraspResult
    from gripper.values.state import (
        Cycle as Cycle,
        GripperPhase as GripperPhase,
        ServoFeedback as ServoFeedback,
    )

_FACE = {
    "gripper.errors": "GripperError",
    "gripper.force.ramp": "ForceRamp",
    "gripper.values.force_sensor": "ForceSample ForceSensor",
    "gripper.gripper": "Gripper open_gripper",
    "gripper.mechanics.kinematics": "Linkage ParallelLinkage RackPinion",
    "gripper.values.outcome": "GraspOutcome GraspResult",
    "gripper.settings": "ForceLoopSettings GripperSettings OverForce ServoSettings",
    "gripper.values.state": "Cycle GripperPhase ServoFeedback",
}
"""Names by module, which is imported when one of them is first used."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
