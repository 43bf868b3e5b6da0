"""Force ramp: the set-point of the grip force over time as a value, its limits and its end."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

from gripper.errors import LimitExceeded
from gripper.mechanics.impact import check_approach
from gripper.mechanics.transmission import Mechanics
from gripper.servos.winding import longest_s
from gripper.settings import check_number, largest_setpoint_n


@dataclass(frozen=True, slots=True, kw_only=True)
class RampSegment:
    """One piece of a ramp: a straight line.

    The force law plans a force whose rate does not jump at its ends.
    """

    duration_s: float
    """Length of the piece in s."""
    start_n: float
    end_n: float
    """Force at its ends in N."""
    level: int | None = None
    """Index of the level of a hold; None while the force changes."""

    @property
    def rate_n_s(self) -> float:
        """Magnitude of the rate in N/s."""
        change_n = abs(self.end_n - self.start_n)
        return change_n / self.duration_s if change_n > 0.0 else 0.0

    def force_n(self, elapsed_s: float) -> float:
        """Return the force in N at a time within the piece."""
        if self.duration_s <= 0.0 or elapsed_s >= self.duration_s:
            return self.end_n
        share = max(0.0, elapsed_s) / self.duration_s
        return self.start_n + share * (self.end_n - self.start_n)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceRamp:
    """Set-point of the grip force, continuous and monotone from its start to its end.

    Made by `linear` or `staircase`.
    """

    segments: tuple[RampSegment, ...]
    """The pieces, in order; each starts at the force where the one before ends."""

    def __post_init__(self) -> None:
        if not self.segments:
            raise LimitExceeded("a ramp needs at least one segment")
        force_n = self.segments[0].start_n
        signs: set[bool] = set()
        for segment in self.segments:
            check_number("duration_s of a segment", segment.duration_s, low=0.0)
            check_number("start_n of a segment", segment.start_n, low=0.0)
            check_number("end_n of a segment", segment.end_n, low=0.0)
            if segment.start_n != force_n:
                raise LimitExceeded(
                    f"a segment starts at {segment.start_n} N, the one before ends at {force_n} N"
                )
            if segment.end_n != segment.start_n:
                check_number("duration_s of a change of force", segment.duration_s, above=0.0)
                signs.add(segment.end_n > segment.start_n)
            force_n = segment.end_n
        if len(signs) > 1:
            raise LimitExceeded("a ramp goes up or down, not both")

    @classmethod
    def linear(
        cls, force_n: float, rate_n_s: float, hold_s: float = 0.0, start_n: float = 0.0
    ) -> "ForceRamp":
        """Return a straight line from start_n to force_n at rate_n_s (a magnitude), then a hold."""
        return cls.staircase(
            (check_number("force_n", force_n, low=0.0),), rate_n_s, hold_s, start_n
        )

    @classmethod
    def staircase(
        cls, levels_n: Sequence[float], rate_n_s: float, hold_s: float, start_n: float = 0.0
    ) -> "ForceRamp":
        """Return straight lines between levels at rate_n_s, each level held for hold_s s."""
        if not levels_n:
            raise LimitExceeded("levels_n is empty, a staircase needs at least one level")
        check_number("rate_n_s", rate_n_s, above=0.0)
        check_number("hold_s", hold_s, low=0.0)
        segments: list[RampSegment] = []
        force_n = check_number("start_n", start_n, low=0.0)
        for index, level_n in enumerate(levels_n):
            rise_s = abs(check_number(f"levels_n[{index}]", level_n, low=0.0) - force_n) / rate_n_s
            segments.append(RampSegment(duration_s=rise_s, start_n=force_n, end_n=level_n))
            segments.append(_hold(level_n, hold_s, index))
            force_n = level_n
        return cls(segments=tuple(segments))

    @property
    def duration_s(self) -> float:
        """Whole length in s, holds included."""
        return sum(segment.duration_s for segment in self.segments)

    @property
    def start_n(self) -> float:
        """Force at the beginning in N."""
        return self.segments[0].start_n

    @property
    def final_n(self) -> float:
        """Force at the end in N."""
        return self.segments[-1].end_n

    @property
    def max_rate_n_s(self) -> float:
        """Largest magnitude of the rate in N/s."""
        return max(segment.rate_n_s for segment in self.segments)

    def setpoint_n(self, elapsed_s: float) -> float:
        """Return the force in N at a time since the start; the ends extend without bound."""
        segment, within_s = self.at(elapsed_s)
        return segment.force_n(within_s)

    def at(self, elapsed_s: float) -> tuple[RampSegment, float]:
        """Return the piece of a time since the start, and the time within it, both in s."""
        for segment in self.segments[:-1]:
            if elapsed_s < segment.duration_s:
                return segment, elapsed_s
            elapsed_s -= segment.duration_s
        return self.segments[-1], elapsed_s

    def ended_at(self, elapsed_s: float, *, most_n: float = inf) -> "ForceRamp":
        """Return a ramp that ends at the force of a time since the start, without a hold.

        Its level is the one held then, or else the next one, with at most ``most_n`` N.
        """
        segment, within_s = self.at(elapsed_s)
        following = self.segments[self.segments.index(segment) :]
        level = next((s.level for s in following if s.level is not None), None)
        return ForceRamp(segments=(_hold(min(segment.force_n(within_s), most_n), 0.0, level),))

    def starting_from(self, force_n: float) -> "ForceRamp":
        """Return this ramp begun at a measured force, so that the set-point never jumps.

        The part of the ramp before ``force_n`` is omitted. If the ramp starts beyond ``force_n``, a
        straight line at its largest rate comes first. For a force beyond the final one the line
        goes back to the final force.

        Parameters
        ----------
        force_n
            Grip force now in N; a negative reading counts as 0.
        """
        force_n = max(0.0, check_number("force_n", force_n))
        rising = self.final_n >= self.start_n
        if (force_n < self.start_n) if rising else (force_n > self.start_n):
            return ForceRamp(segments=(self._lead_in(force_n, self.start_n), *self.segments))
        for index, segment in enumerate(self.segments):
            low_n, high_n = sorted((segment.start_n, segment.end_n))
            if low_n <= force_n <= high_n and force_n != segment.end_n:
                share = (segment.end_n - force_n) / (segment.end_n - segment.start_n)
                cut = replace(segment, duration_s=segment.duration_s * share, start_n=force_n)
                return ForceRamp(segments=(cut, *self.segments[index + 1 :]))
        final_hold = tuple(s for s in self.segments[-1:] if s.start_n == s.end_n)
        return ForceRamp(segments=(self._lead_in(force_n, self.final_n), *final_hold))

    def _lead_in(self, from_n: float, to_n: float) -> RampSegment:
        duration_s = abs(to_n - from_n) / (self.max_rate_n_s or 1.0)
        return RampSegment(duration_s=duration_s, start_n=from_n, end_n=to_n)


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


def _hold(force_n: float, duration_s: float, level: int | None) -> RampSegment:
    return RampSegment(duration_s=duration_s, start_n=force_n, end_n=force_n, level=level)
