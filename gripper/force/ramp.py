"""Force ramp: the set-point of the grip force over time as a value, its limits and its end."""

from dataclasses import dataclass, replace
from math import inf

from gripper.errors import LimitExceeded
from gripper.mechanics.impact import check_approach
from gripper.mechanics.transmission import Mechanics
from gripper.servos.winding import longest_s
from gripper.settings import check_number, largest_setpoint_n


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceRamp:
    """Set-point of the grip force: a straight line up or down, then a hold.

    The force law plans a force whose rate does not jump at its ends.
    """

    start_n: float = 0.0
    final_n: float
    """Force at its ends in N."""
    rate_n_s: float
    """Magnitude of its rate in N/s."""
    hold_s: float = 0.0
    """Time at its end in s."""

    def __post_init__(self) -> None:
        check_number("rate_n_s", self.rate_n_s, above=0.0)
        for name in ("start_n", "final_n", "hold_s"):
            check_number(name, getattr(self, name), low=0.0)

    @classmethod
    def linear(
        cls, force_n: float, rate_n_s: float, hold_s: float = 0.0, start_n: float = 0.0
    ) -> "ForceRamp":
        """Return a straight line from start_n to force_n at rate_n_s (a magnitude), then a hold."""
        return cls(start_n=start_n, final_n=force_n, rate_n_s=rate_n_s, hold_s=hold_s)

    @classmethod
    def steady(cls, force_n: float) -> "ForceRamp":
        """Return a ramp that stays at a force in N."""
        return cls.linear(force_n, 1.0, start_n=force_n)

    @property
    def change_s(self) -> float:
        """Length of the change of force in s."""
        return abs(self.final_n - self.start_n) / self.rate_n_s

    @property
    def duration_s(self) -> float:
        """Whole length in s, with the hold."""
        return self.change_s + self.hold_s

    def setpoint_n(self, elapsed_s: float) -> float:
        """Return the force in N at a time since the start, which is at least 0."""
        if elapsed_s >= self.change_s:
            return self.final_n
        return self.start_n + elapsed_s / self.change_s * (self.final_n - self.start_n)

    def starting_from(self, force_n: float) -> "ForceRamp":
        """Return this ramp begun at a measured force in N, so that the set-point does not jump.

        A negative reading counts as 0. From a force beyond the end the line goes back to it.
        """
        return replace(self, start_n=max(0.0, check_number("force_n", force_n)))


def largest_ramp_n(mechanics: Mechanics) -> float:
    """Return the force in N up to which cap and current allow a ramp, at any opening."""
    by_current_n = mechanics.loaded_n(mechanics.end_transmissions())
    return min(largest_setpoint_n(mechanics.settings.force_max_n), by_current_n)


def check_ramp(ramp: ForceRamp, mechanics: Mechanics) -> None:
    """Check a ramp against the limits of a gripper, before anything moves.

    Raises
    ------
    LimitExceeded
        When a limit does not allow the ramp; the allowed number is named.
    """
    settings, largest_n = mechanics.settings, max(ramp.start_n, ramp.final_n)
    limit_n = largest_setpoint_n(settings.force_max_n)
    if largest_n > limit_n:
        raise LimitExceeded(
            f"at most {limit_n:.2f} N, so that its overshoot stays below "
            f"force_max_n = {settings.force_max_n} N; the ramp asks for {largest_n} N: lower it, "
            "or raise force_max_n"
        )
    if ramp.final_n < settings.contact_force_n:
        raise LimitExceeded(
            f"at least {settings.contact_force_n} N, contact_force_n: a ramp to {ramp.final_n} N "
            "could not hold a part"
        )
    needed_a = max(path.loading_current_a(largest_n) for path in mechanics.end_transmissions())
    if needed_a > settings.current_max_a:
        raise LimitExceeded(
            f"{largest_n} N take {needed_a:.3f} A, current_max_a is {settings.current_max_a} "
            f"A: lower the force or shorten the lever of the linkage"
        )
    check_approach(mechanics)


def heat_note(force_n: float, mechanics: Mechanics) -> str:
    """Return a note on a force in N that the servos cannot hold for hours; empty if they can."""
    least_s, note = inf, ""
    servos = mechanics.settings.servos * 2
    for path, servo in zip(mechanics.end_transmissions(), servos, strict=True):
        current_a, model = path.loading_current_a(force_n), servo.servo_model
        if (lasts_s := longest_s(model, current_a)) < least_s:
            least_s = lasts_s
            note = (
                f"a grip of {force_n:g} N takes {current_a:.2f} A, and {model.name} bears "
                f"{model.holding_a:.2f} A for hours: after {lasts_s:.1f} s at most its current is "
                f"lowered to that, and the part is held with less force, unless the servo's own "
                f"protection drops it. Ask for less force, take a shorter lever or a stronger servo"
            )
    return note
