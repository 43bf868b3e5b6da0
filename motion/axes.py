"""Axes in m and rad: limits, motion of several axes together, the stop of all of them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from motion.bus import Watch, unwatched
from motion.errors import (
    AxisDuplicated,
    AxisLimitExceeded,
    MotionError,
    PositionImplausible,
    PositionNotReached,
)

_POLL_S = 0.005
"""Period in s of the polls of moving axes."""
_STOP_S = 0.2
"""Longest time in s of a stop in addition to braking: for the command and the settling."""
_TIME_FACTOR, _TIME_S = 2.0, 2.0
"""Longest time of a travel: factor on its time by velocity and acceleration, and s to add."""


class AxisDevice(Protocol):
    """A drive or servo that moves one axis, in its own increments."""

    name: str

    def identify(self) -> str:
        """Return state and position in words; nothing moves."""

    def prepare(self, *, reset: bool) -> None:
        """Set up, enable, find the home; the axis may move. A fault is cleared with ``reset``."""

    def clear_fault(self, *, reboot: bool) -> None:
        """Clear a fault; a device that must restart for it does so with ``reboot`` only."""

    def wake(self) -> None:
        """Check that the device has not changed since its last use."""

    def go_to(self, target: int) -> None:
        """Begin to move."""

    def arrived(self) -> bool:
        """Return whether the target is reached. Raises MotionError for a device at fault."""

    def rest(self) -> None:
        """End a motion that has arrived: the device needs no supervision now."""

    @property
    def position(self) -> int:
        """Present position in increments."""

    def stop(self) -> None:
        """Send a stop without a wait."""

    def standing(self) -> bool:
        """Return whether the axis stands still after a stop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One axis: its device, and the meaning of its increments."""

    name: str
    """Name of the axis."""
    device: AxisDevice
    """Drive or servo."""
    increments: float
    """Increments in one m or rad; negative if the device counts the other way."""
    low: float
    high: float
    """Limits in m or rad."""
    plausible: tuple[float, float]
    """Lowest and highest plausible position in m or rad: by limits, home and lag."""
    velocity: float
    acceleration: float
    """Of its profile in m/s and m/s², or rad/s and rad/s²; for the longest time of a travel."""
    unit: str
    units_per_si: float
    """Unit of messages, and its number in one m or rad."""

    @property
    def position(self) -> float:
        """Present position in m or rad.

        Raises PositionImplausible if the axis cannot be there.
        """
        position = self.device.position / self.increments
        low, high = self.plausible
        if not low <= position <= high:
            raise PositionImplausible(
                f"{self.device.name} reads a position of {self.in_words(position)}, its limits are "
                f"{self.in_words(self.low)} to {self.in_words(self.high)}: the reading has jumped, "
                "or the axis was moved beyond its limits. Check encoder and homing, bring the axis "
                "back between its limits, then clear the fault and start again"
            )
        return position

    def arrived(self) -> bool:
        """Return whether the target is reached. Raises MotionError as device and `position`."""
        arrived = self.device.arrived()
        _ = self.position
        return arrived

    def target(self, position: float) -> int:
        """Return a position in increments.

        Raises AxisLimitExceeded if it is not a number or outside the limits of the axis.
        """
        if not self.low <= position <= self.high:
            raise AxisLimitExceeded(
                f"axis {self.name} was asked for {self.in_words(position)}, its limits are "
                f"{self.in_words(self.low)} to {self.in_words(self.high)}; nothing has moved"
            )
        return round(position * self.increments)

    def in_words(self, position: float) -> str:
        """Return a position with its unit."""
        return f"{position * self.units_per_si:.2f} {self.unit}"

    def longest_s(self, way: float) -> float:
        """Return the longest time in s for a travel in m or rad."""
        time_s = abs(way) / self.velocity + self.velocity / self.acceleration
        return _TIME_FACTOR * time_s + _TIME_S


class Axes:
    """All axes of a positioner, moved together and stopped together."""

    def __init__(self, axes: Sequence[Axis], watch: Watch) -> None:
        self._axes = {axis.name: axis for axis in axes}
        self._watch = watch
        self._ready = False
        self._reported = False

    @property
    def ready(self) -> bool:
        """Whether the axes are enabled and homed, so that no motion begins with homing."""
        return self._ready

    def inspect(self) -> dict[str, str | MotionError]:
        """Return the state or the error of each device by axis; nothing moves."""
        states: dict[str, str | MotionError] = {}
        for axis in self._axes.values():
            try:
                states[axis.device.name] = axis.device.identify()
            except MotionError as error:
                states[axis.device.name] = error
        return states

    def clear_faults(self, *, reboot: bool) -> None:
        """Clear the faults of all devices, also those of an earlier program; nothing moves.

        Raises MotionError if a device does not answer or stays at fault.

        Parameters
        ----------
        reboot
            True to restart servos at fault, which drop their load.
        """
        self._ready = False
        for axis in self._axes.values():
            axis.device.clear_fault(reboot=reboot)

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
        increments = {name: self._axes[name].target(value) for name, value in targets.items()}
        self._watch.supervise = supervise
        try:
            for axis in self._axes.values():
                if self._ready:
                    axis.device.wake()
                else:
                    axis.device.prepare(reset=self._reported)
            self._ready, self._reported = True, False
            return self._move(targets, increments)
        except BaseException as error:
            raised = self.stop()
            if not isinstance(error, MotionError):
                raise
            self._ready, self._reported = False, True
            # Two drives with one node-ID cause many errors: a boot-up, a fault, a wrong state.
            states = self.inspect().values()
            cause = next((state for state in states if isinstance(state, AxisDuplicated)), error)
            raise type(cause)(f"{cause}; {raised}") from cause
        finally:
            self._watch.supervise = unwatched

    def _move(
        self, targets: Mapping[str, float], increments: Mapping[str, int]
    ) -> dict[str, float]:
        longest_s = max(
            axis.longest_s(targets[name] - axis.position)
            for name, axis in self._axes.items()
            if name in targets
        )
        end_s = self._watch.clock.monotonic() + longest_s
        for name, target in increments.items():
            self._axes[name].device.go_to(target)
        # Arrived axes are polled too: if one of them fails, the others stop.
        while under_way := [name for name in targets if not self._axes[name].arrived()]:
            if self._watch.clock.monotonic() > end_s:
                where = ", ".join(
                    f"{name} is at {axis.in_words(axis.position)} instead of "
                    f"{axis.in_words(targets[name])}"
                    for name, axis in self._axes.items()
                    if name in under_way
                )
                raise PositionNotReached(
                    f"after {longest_s:.1f} s {where}: is something in its way?"
                )
            self._watch.pause(_POLL_S)
        for name in targets:
            self._axes[name].device.rest()
        return {name: self._axes[name].position for name in targets}

    def stop(self) -> str:
        """Stop all axes at once, wait until they stand, and return the result as text."""
        devices = [axis.device for axis in self._axes.values()]
        for device in devices:
            with suppress(MotionError):
                device.stop()
        self._watch.supervise = _undisturbed(self._watch.supervise)
        braking_s = max(axis.velocity / axis.acceleration for axis in self._axes.values())
        end_s = self._watch.clock.monotonic() + braking_s + _STOP_S
        moving = devices
        while moving and self._watch.clock.monotonic() < end_s:
            self._watch.pause(_POLL_S)
            moving = [device for device in moving if not _stands(device)]
        if not moving:
            return "all axes stand still"
        names = ", ".join(device.name for device in moving)
        return f"not confirmed to stand still: {names}"


def _stands(device: AxisDevice) -> bool:
    try:
        return device.standing()
    except MotionError:
        return False


def _undisturbed(supervise: Callable[[], None]) -> Callable[[], None]:
    """Return a supervision for the stop of axes, without its errors."""

    def guarded() -> None:
        # The stop of the axes has priority; the earlier error ends the motion.
        with suppress(Exception):
            supervise()

    return guarded
