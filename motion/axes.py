"""Axes in m and rad: one axis with its device, the motion of several, the stop of all of them."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from math import degrees

from motion import errors
from tactile.clock import Clock

POLL_S = 0.005
"""Period in s of the polls of moving axes."""
_TIME_FACTOR, _TIME_S = 2.0, 2.0
"""Longest time of a travel: factor on its time by velocity and acceleration, and s to add."""
_STOP_S = 0.2
"""Longest time in s of a stop in addition to braking: for the command and the settling."""


def unwatched() -> None:
    """Do nothing: the default supervision of a motion."""


class Watch:
    """Supervision during waits: called once a period while an axis moves or answers.

    Parameters
    ----------
    period_s
        Least time in s between two calls.
    """

    def __init__(self, clock: Clock, period_s: float) -> None:
        self.clock = clock
        self.supervise: Callable[[], None] = unwatched
        """The called function; its error ends the motion."""
        self._period_s = period_s
        self._due_s = clock.monotonic()

    def look(self) -> None:
        """Call the supervision if it is due."""
        now_s = self.clock.monotonic()
        if now_s >= self._due_s:
            self._due_s = now_s + self._period_s
            self.supervise()

    def pause(self, seconds: float) -> None:
        """Wait for a time in s under supervision."""
        end_s = self.clock.monotonic() + seconds
        while (left_s := end_s - self.clock.monotonic()) > 0.0:
            self.clock.sleep(min(left_s, self._period_s))
            self.look()


@dataclass(frozen=True, kw_only=True)
class AxisSettings:
    """One axis in m or rad."""

    name: str
    """Part of the pose that it moves."""
    increments: float
    """Increments of the device in one m or rad; negative if it counts the other way."""
    low: float
    high: float
    """Limits in m or rad."""
    velocity: float
    acceleration: float
    """Of its profile in m/s and m/s², or rad/s and rad/s²."""
    window: float
    """Largest distance of a reached target in m or rad."""
    lag: float
    """Largest distance to the position of the profile in m or rad."""
    linear: bool
    """Whether it moves along a line, so that messages have mm, or turns."""

    def counts(self, value: float) -> int:
        """Return a distance, speed or acceleration in increments, at least 1."""
        return max(1, abs(round(value * self.increments)))

    @property
    def limits(self) -> tuple[int, int]:
        """The limits in increments, the smaller one first."""
        low, high = sorted(round(end * self.increments) for end in (self.low, self.high))
        return low, high

    def in_words(self, position: float) -> str:
        """Return a position with its unit."""
        return f"{position * 1e3:.2f} mm" if self.linear else f"{degrees(position):.2f} deg"

    @property
    def limits_in_words(self) -> str:
        """The limits with their unit."""
        return f"its limits are {self.in_words(self.low)} to {self.in_words(self.high)}"

    def longest_s(self, way: float) -> float:
        """Return the longest time in s for a travel in m or rad."""
        time_s = abs(way) / self.velocity + self.velocity / self.acceleration
        return _TIME_FACTOR * time_s + _TIME_S


class Axis(ABC):
    """One axis with its drive or servo.

    Parameters
    ----------
    device
        The device in words.
    home
        Position where the axis may stand beyond its limits, in m or rad.
    """

    def __init__(
        self, settings: AxisSettings, device: str, watch: Watch, home: float | None = None
    ) -> None:
        self.name = settings.name
        self.label = f"axis {settings.name} ({device})"
        """Axis and device in words."""
        self.settings: AxisSettings = settings
        self._watch = watch
        ends = [settings.low, settings.high, *([] if home is None else [home])]
        slack = settings.window + settings.lag
        self._plausible = min(ends) - slack, max(ends) + slack

    @property
    def position(self) -> float:
        """Present position in m or rad.

        Raises PositionImplausible if the axis cannot be there.
        """
        settings, (low, high) = self.settings, self._plausible
        position = self.read_increments() / settings.increments
        if not low <= position <= high:
            raise errors.PositionImplausible(
                f"{self.label} reads a position of {settings.in_words(position)}, "
                f"{settings.limits_in_words}: the reading has jumped, or the axis was moved beyond "
                "its limits. Check encoder and homing, bring the axis back between its limits"
            )
        return position

    def target(self, position: float) -> int:
        """Return a position in increments.

        Raises AxisLimitExceeded if it is not a number or outside the limits of the axis.
        """
        settings = self.settings
        if not settings.low <= position <= settings.high:
            raise errors.AxisLimitExceeded(
                f"axis {self.name} was asked for {settings.in_words(position)}, "
                f"{settings.limits_in_words}; nothing has moved"
            )
        return round(position * settings.increments)

    @abstractmethod
    def identify(self) -> str:
        """Return state and position in words; nothing is changed and nothing moves.

        Raises AxisSilent without an answer, AxisMissing for another device than configured.
        """

    @abstractmethod
    def prepare(self, *, reset: bool) -> None:
        """Set up, enable, find the home; the axis may move. A fault is cleared with ``reset``."""

    @abstractmethod
    def clear_fault(self, *, reboot: bool) -> None:
        """Clear a fault; a device that must restart for it does so with ``reboot`` only.

        The device is not enabled and does not move. Raises MotionError if it is missing, or its
        fault stays.
        """

    @abstractmethod
    def wake(self) -> None:
        """Check that the device still answers, is enabled and has no fault."""

    @abstractmethod
    def go_to(self, position: float) -> None:
        """Begin to move to a position in m or rad; the only place where a target is written.

        Raises AxisLimitExceeded as `target`.
        """

    @abstractmethod
    def arrived(self) -> bool:
        """Return whether the target is reached. Raises MotionError for a device at fault."""

    @abstractmethod
    def rest(self) -> None:
        """End a motion that has arrived: the device needs no supervision now."""

    @abstractmethod
    def read_increments(self) -> int:
        """Return the present position in increments."""

    @abstractmethod
    def stop(self) -> None:
        """Send a stop without a wait."""

    @abstractmethod
    def standing(self) -> bool:
        """Return whether the axis stands still after a stop."""


class Axes:
    """All axes of a positioner, moved together and stopped together."""

    def __init__(self, axes: Sequence[Axis], watch: Watch) -> None:
        self._axes = {axis.name: axis for axis in axes}
        self._watch = watch
        self.ready = False
        """Whether the axes are enabled and homed, so that no motion begins with homing."""
        self._reported = False

    def inspect(self) -> dict[str, str | errors.MotionError]:
        """Return the state or the error of each device by axis; nothing moves."""
        states: dict[str, str | errors.MotionError] = {}
        for axis in self._axes.values():
            try:
                states[axis.label] = axis.identify()
            except errors.MotionError as error:
                states[axis.label] = error
        return states

    def clear_faults(self, *, reboot: bool) -> None:
        """Clear the faults of all devices, also those of an earlier program; nothing moves.

        Raises MotionError if a device does not answer or stays at fault; the others are cleared.

        Parameters
        ----------
        reboot
            True to restart servos at fault, which drop their load.
        """
        self.ready = False
        # The stack calls each of them, also after the error of another.
        with ExitStack() as calls:
            for axis in self._axes.values():
                calls.callback(axis.clear_fault, reboot=reboot)

    def move(
        self, targets: Mapping[str, float], supervise: Callable[[], None] = unwatched
    ) -> dict[str, float]:
        """Move to positions in m or rad by axis; return the positions that were reached.

        The first motion, and the first one after a fault, prepares the devices: it enables them and
        finds their homes, one axis after the other. It clears the fault of a device only if that
        was raised before, so the caller has seen it.

        Raises AxisLimitExceeded if a target is outside its limits; nothing has moved. Raises
        PositionNotReached if a travel takes too long; all axes were stopped. Raises MotionError if
        a device is at fault or silent. All axes were stopped, and are prepared again.

        An error of ``supervise`` stops all axes too. They keep their positions and continue from
        there.
        """
        for name, position in targets.items():
            self._axes[name].target(position)
        self._watch.supervise = supervise
        try:
            for axis in self._axes.values():
                if self.ready:
                    axis.wake()
                else:
                    axis.prepare(reset=self._reported)
            self.ready, self._reported = True, False
            return self._move(targets)
        except BaseException as error:
            stopped = self.stop()
            if not isinstance(error, errors.MotionError):
                raise
            self.ready, self._reported = False, True
            # Two drives with one node-ID cause many errors: a boot-up, a fault, a wrong state.
            states = self.inspect().values()
            cause = next(
                (state for state in states if isinstance(state, errors.AxisDuplicated)), error
            )
            if not isinstance(cause, errors.PositionNotReached):
                stopped += ". Then clear the fault and start again"
            raise type(cause)(f"{cause}; {stopped}") from cause
        finally:
            self._watch.supervise = unwatched

    def _move(self, targets: Mapping[str, float]) -> dict[str, float]:
        moved = {self._axes[name]: position for name, position in targets.items()}
        longest_s = max(
            axis.settings.longest_s(position - axis.position) for axis, position in moved.items()
        )
        end_s = self._watch.clock.monotonic() + longest_s
        for axis, position in moved.items():
            axis.go_to(position)
        while True:
            # Arrived axes are polled too: if one of them fails, the others stop.
            reached = {axis: (axis.arrived(), axis.position) for axis in moved}
            if all(arrived for arrived, _ in reached.values()):
                break
            if self._watch.clock.monotonic() > end_s:
                where = ", ".join(
                    f"{axis.name} is at {axis.settings.in_words(position)} instead of "
                    f"{axis.settings.in_words(moved[axis])}"
                    for axis, (arrived, position) in reached.items()
                    if not arrived
                )
                raise errors.PositionNotReached(
                    f"after {longest_s:.1f} s {where}: is something in its way?"
                )
            self._watch.pause(POLL_S)
        for axis in moved:
            axis.rest()
        return {axis.name: axis.position for axis in moved}

    def stop(self) -> str:
        """Stop all axes at once, wait until they stand, and return the result as text."""
        supervise = self._watch.supervise

        def undisturbed() -> None:
            # The stop of the axes has priority; the earlier error ends the motion.
            with suppress(Exception):
                supervise()

        self._watch.supervise = undisturbed
        moving = list(self._axes.values())
        for axis in moving:
            with suppress(errors.MotionError):
                axis.stop()
        braking_s = max(axis.settings.velocity / axis.settings.acceleration for axis in moving)
        end_s = self._watch.clock.monotonic() + braking_s + _STOP_S
        while moving and self._watch.clock.monotonic() < end_s:
            self._watch.pause(POLL_S)
            moving = [axis for axis in moving if not _stands(axis)]
        if not moving:
            return "all axes stand still"
        return f"not confirmed to stand still: {', '.join(axis.label for axis in moving)}"


def _stands(axis: Axis) -> bool:
    try:
        return axis.standing()
    except errors.MotionError:
        return False
