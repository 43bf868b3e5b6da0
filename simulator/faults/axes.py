"""Named faults of the axes that carry the object: of drives, and of a servo as wrist."""

from simulator.can.drive import SimulatedDrive
from simulator.errors import SimulatorSettingsError
from simulator.faults.entry import (
    FaultEntry,
    FaultKind,
    Number,
    Target,
    Undo,
    knob_fault,
    turned,
)
from simulator.servo.wrist import SimulatedWrist


def _axis(target: Target) -> SimulatedDrive | SimulatedWrist:
    return list(target.devices.axes.values())[target.servo]


def _drive(target: Target) -> SimulatedDrive:
    axis = _axis(target)
    if isinstance(axis, SimulatedDrive):
        return axis
    raise SimulatorSettingsError("this fault is for drives, but the axis is a servo")


def _blocked(target: Target) -> Undo:
    axis = _axis(target)
    owner = axis.motion if isinstance(axis, SimulatedDrive) else axis
    return turned(owner, "blocked", True)


def _silence(target: Target) -> Undo:
    axis = _axis(target)
    if isinstance(axis, SimulatedDrive):
        return turned(axis, "dead", True)
    return turned(axis.bus.faults, "silent", {axis.mount.servo_id})


def _fault(target: Target) -> None:
    axis = _axis(target)
    if isinstance(axis, SimulatedDrive):
        axis.fail(int(target.number))
    else:
        axis.servo.core.plant.overload()


def _reboot(target: Target) -> None:
    axis = _axis(target)
    if isinstance(axis, SimulatedDrive):
        axis.power_cycle()
    else:
        axis.servo.core.boot(target.now_s)


# fmt: off
AXIS = (
    FaultEntry("axisN.following_error", FaultKind.STUCK,
               "the axis is blocked: it does not follow its set-point, a servo stalls",
               _blocked, "axis_blocked"),
    FaultEntry("axisN.silence", FaultKind.OFF,
               "its drive or servo receives and sends nothing; its motion goes on", _silence,
               "axis_silent"),
    knob_fault("axisN.limit_switch", FaultKind.STUCK,
               "the negative (-1) or positive (1) limit switch of its drive is active",
               "forced_switch", Number("end", -1, 1, default=1, whole=True), owner=_drive),
    FaultEntry("axisN.fault", FaultKind.WRONG,
               "its drive goes to fault with this error code (603Fh); a servo is overloaded",
               _fault, value=Number("code", 1, 0xFFFF, default=0x2310, whole=True), moment=True),
    FaultEntry("axisN.reboot", FaultKind.REBOOT,
               "its drive or servo restarts: torque off, set-up and position lost", _reboot,
               moment=True),
)
# fmt: on
