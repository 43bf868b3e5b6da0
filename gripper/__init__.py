"""Force-controlled two-finger gripper on DYNAMIXEL X servos.

The public names of the package, loaded on first use: importing `gripper` or one of its pure
modules (`gripper.registers`, `gripper.ramp`) loads neither a serial port nor the SDK.

Commands and their values: `Gripper`, `GripperSettings`, `ServoSettings`, `ForceLoopSettings`,
`OverForce`, `ForceRamp`, `Cycle`, `GripperState`, `ServoState`, `GripperPhase`, `GraspOutcome`,
`GraspResult`, `LoopStatistics`, `VerificationReport`, `VerificationRow`, `WatchdogProof`.
Mechanics: `Linkage`, `ParallelLinkage`, `RackPinion`, `Transmission`.
Force in: `ForceSample`, `ForceSensor`. Time: `Clock`.
Bus: `ServoBus`, `BusStatistics`, `ServoIdentity`, `LinkTiming`, `SerialStream`, `ByteStream`.
Errors: `GripperError` and all below it, see `gripper.errors`.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gripper.bus import ServoBus, ServoIdentity
    from gripper.clock import Clock
    from gripper.errors import (
        BusBusy,
        BusCorrupt,
        BusTimeout,
        FeedbackImplausible,
        FingerSilent,
        ForceAboveCap,
        ForceImbalance,
        ForceSensorStale,
        GraspStopped,
        GripperError,
        GripperStateError,
        LimitExceeded,
        LinkTooSlow,
        PartLost,
        PartSlipped,
        PortLost,
        ServoFault,
        ServoMissing,
        ServoRejected,
        VerificationFailed,
        WatchdogUnproven,
    )
    from gripper.force import ForceSample, ForceSensor
    from gripper.gripper import Gripper
    from gripper.kinematics import Linkage, ParallelLinkage, RackPinion, Transmission
    from gripper.line import BusStatistics
    from gripper.link_check import LinkTiming
    from gripper.port import ByteStream, SerialStream
    from gripper.ramp import ForceRamp
    from gripper.settings import ForceLoopSettings, GripperSettings, OverForce, ServoSettings
    from gripper.state import (
        Cycle,
        GraspOutcome,
        GraspResult,
        GripperPhase,
        GripperState,
        LoopStatistics,
        ServoState,
    )
    from gripper.verification import VerificationReport, VerificationRow
    from gripper.watchdog_test import WatchdogProof

_HOME = {
    "gripper.bus": ("ServoBus", "ServoIdentity"),
    "gripper.clock": ("Clock",),
    "gripper.errors": (
        "BusBusy",
        "BusCorrupt",
        "BusTimeout",
        "FeedbackImplausible",
        "FingerSilent",
        "ForceAboveCap",
        "ForceImbalance",
        "ForceSensorStale",
        "GraspStopped",
        "GripperError",
        "GripperStateError",
        "LimitExceeded",
        "LinkTooSlow",
        "PartLost",
        "PartSlipped",
        "PortLost",
        "ServoFault",
        "ServoMissing",
        "ServoRejected",
        "VerificationFailed",
        "WatchdogUnproven",
    ),
    "gripper.force": ("ForceSample", "ForceSensor"),
    "gripper.gripper": ("Gripper",),
    "gripper.kinematics": ("Linkage", "ParallelLinkage", "RackPinion", "Transmission"),
    "gripper.line": ("BusStatistics",),
    "gripper.port": ("ByteStream", "SerialStream"),
    "gripper.ramp": ("ForceRamp",),
    "gripper.link_check": ("LinkTiming",),
    "gripper.settings": ("ForceLoopSettings", "GripperSettings", "OverForce", "ServoSettings"),
    "gripper.state": (
        "Cycle",
        "GraspOutcome",
        "GraspResult",
        "GripperPhase",
        "GripperState",
        "LoopStatistics",
        "ServoState",
    ),
    "gripper.verification": ("VerificationReport", "VerificationRow"),
    "gripper.watchdog_test": ("WatchdogProof",),
}
_MODULE_OF = {name: module for module, names in _HOME.items() for name in names}

__all__ = [
    "BusBusy",
    "BusCorrupt",
    "BusStatistics",
    "BusTimeout",
    "ByteStream",
    "Clock",
    "Cycle",
    "FeedbackImplausible",
    "FingerSilent",
    "ForceAboveCap",
    "ForceImbalance",
    "ForceLoopSettings",
    "ForceRamp",
    "ForceSample",
    "ForceSensor",
    "ForceSensorStale",
    "GraspOutcome",
    "GraspResult",
    "GraspStopped",
    "Gripper",
    "GripperError",
    "GripperPhase",
    "GripperSettings",
    "GripperState",
    "GripperStateError",
    "LimitExceeded",
    "LinkTiming",
    "LinkTooSlow",
    "Linkage",
    "LoopStatistics",
    "OverForce",
    "ParallelLinkage",
    "PartLost",
    "PartSlipped",
    "PortLost",
    "RackPinion",
    "SerialStream",
    "ServoBus",
    "ServoFault",
    "ServoIdentity",
    "ServoMissing",
    "ServoRejected",
    "ServoSettings",
    "ServoState",
    "Transmission",
    "VerificationFailed",
    "VerificationReport",
    "VerificationRow",
    "WatchdogProof",
    "WatchdogUnproven",
]


def __getattr__(name: str) -> object:
    """Load a public name from its module."""
    module = _MODULE_OF.get(name)
    if module is None:
        raise AttributeError(f"module 'gripper' has no attribute {name!r}")
    return getattr(import_module(module), name)


def __dir__() -> list[str]:
    """List the public names."""
    return list(_MODULE_OF)
