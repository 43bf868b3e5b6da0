"""Ends of commands: of a grasp and of a release."""

from dataclasses import dataclass
from enum import Enum

from gripper.values.servo_checks import ServoCondition
from gripper.values.state import ServoFeedback


class GraspResult(Enum):
    """Kind of end of a grasp."""

    FORCE_REACHED = "force_reached"
    FORCE_NOT_REACHED = "force_not_reached"
    NO_CONTACT = "no_contact"
    PART_LOST = "part_lost"


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspOutcome:
    """End of a grasp; the part is held unless no part was found."""

    result: GraspResult
    """The end."""
    contact_t_s: float | None = None
    contact_aperture_m: float | None = None
    """Time and opening of the contact of both pads; None without contact."""
    final_aperture_m: float
    """Opening at the end in m."""
    final_force_n: float = 0.0
    """Grip force at the end in N, mean of the last samples, their number by the noise: three
    frames; 0 without contact."""
    overshoot_n: float = 0.0
    """Largest mean of the last samples, as in ``final_force_n``, minus the end of the ramp in N, at
    least 0."""
    ended_early: bool = False
    """Whether a request ended the ramp early: the force to reach is then the set-point at that
    time."""
    unreached: str = ""
    """The force of a part that is held with another force than asked for, as text, and its cause if
    the fingers reached their smallest opening. Else empty."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseReport:
    """End of a release: the opened fingers, and the servos that could not be moved."""

    state: ServoFeedback
    """Last feedback, only of the opened servos."""
    opened: tuple[int, ...]
    """IDs of the servos whose fingers are open."""
    left: tuple[ServoCondition, ...] = ()
    """The servos that could not be moved."""
    wider: tuple[int, ...] = ()
    """IDs of the servos that report a finger as wider open than the gripper opens; they stay."""

    def __str__(self) -> str:
        if not self.left and not self.wider:
            return "the fingers are open"
        if not self.left:
            wider = ", ".join(map(str, self.wider))
            return (
                f"the fingers are open according to their servos; the finger of servo {wider} was "
                f"not moved, because it is reported as wider open than the gripper opens. If it is "
                f"not, check encoder, horn and zero_pulse of the servo, and gripper.linkage"
            )
        opened = ", ".join(map(str, self.opened))
        remedies = []
        if any(condition.shut_down for condition in self.left):
            remedies.append("after its cause is remedied, clear the error with a reboot")
        if any(condition.strayed for condition in self.left):
            remedies.append(
                "push that finger open by hand and check encoder and horn; after the reset, clear "
                "with a reboot, which restarts the servo"
            )
        if any(not condition.answers for condition in self.left):
            remedies.append(
                "a servo that does not answer may still have its torque: check its supply and cable"
            )
        return (
            f"the finger of servo {opened} is open, the other one was not moved: "
            f"{'; '.join(map(str, self.left))}. {'; '.join(remedies).capitalize()}"
        )
