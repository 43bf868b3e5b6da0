"""One period of the control of a grip, and the interface of its modes."""

from collections.abc import Sequence
from dataclasses import dataclass

from gripper.force.loop import Moment
from gripper.mechanics.kinematics import Transmission
from gripper.values.force_sensor import ForceSample
from gripper.values.state import ServoFeedback


@dataclass(frozen=True, slots=True, kw_only=True)
class Period:
    """One period of control: measurements, set-point, limits."""

    moment: Moment
    """Feedback and newest sample."""
    usable: bool
    """Whether there is a usable sample: a valid one without doubt about the part."""
    quick: bool
    """Whether the loop is fast enough for a planned motion."""
    setpoint_n: float
    rises_n: float
    """Set-point of the grip force in N, and its increase since the last period."""
    arrival_n: float | None
    """End of the present change of force in N; None without a change."""
    taper: bool
    """True during a long hold."""
    paths: Sequence[Transmission]
    friction_n: float
    """Transmission of each servo, and half the width of the friction band in N."""
    doubt_n: float
    """Standard deviation in N of the force by the current alone."""
    drive_max_n: float
    inertia_n: float
    """Largest driving force in N, and how far below it the closing fingers keep, by their speed."""
    may_open: bool
    """Whether the fingers may open farther."""

    @property
    def state(self) -> ServoFeedback:
        """Feedback of the servos."""
        return self.moment.state

    @property
    def sample(self) -> ForceSample:
        """Newest sample, if it is usable."""
        assert self.moment.sample is not None
        return self.moment.sample

    @property
    def may_plan(self) -> bool:
        """Whether the fingers may follow a plan.

        A current in motion does not show the force. Old samples suffice where the gearing sticks:
        there the friction band is worse.
        """
        if not (self.quick and self.usable) or self.sample.by_current:
            return False
        return self.moment.young or any(path.drive.sticks for path in self.paths)

    def held_n(self, drive_n: float) -> float:
        """Return the largest force in N that a drive in N holds, the mean of the servos."""
        return sum(path.held_n(drive_n) for path in self.paths) / len(self.paths)

    def yielding_n(self, force_n: float) -> float:
        """Return the drive in N at which a force in N begins to fall, the mean of the servos."""
        return sum(path.yielding_n(force_n) for path in self.paths) / len(self.paths)

    @property
    def end_n(self) -> float:
        """Force in N at which the present change of force ends."""
        return self.setpoint_n if self.arrival_n is None else self.arrival_n


class Mode:
    """One law of control with its own state."""

    def enter(self, period: Period, before: "Mode") -> None:
        """Begin after another mode."""

    def exit(self, period: Period) -> None:
        """End, before another mode begins."""

    def step(self, period: Period) -> float:
        """Return the driving force in N of one period."""
        raise NotImplementedError
