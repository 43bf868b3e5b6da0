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
"""Period in s in which moving axes are asked."""
_STOP_S = 0.2
"""Time in s that a stop may take beyond that of braking: the way of the command, settling."""
_TIME_FACTOR, _TIME_S = 2.0, 2.0
"""A way may take so many times its time by velocity and acceleration, and so many s more."""


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
        """Look whether the device is as it was left."""

    def go_to(self, target: int) -> None:
        """Begin to move."""

    def arrived(self) -> bool:
        """Return whether the target is reached; raises what went wrong."""

    def rest(self) -> None:
        """End a motion that has arrived: nobody has to watch the device any more."""

    @property
    def position(self) -> int:
        """Present position in increments."""

    def stop(self) -> None:
        """Send a stop and wait for nothing."""

    def standing(self) -> bool:
        """Return whether the axis stands still after a stop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Axis:
    """One axis: its device, and what its increments are."""

    name: str
    """What it moves."""
    device: AxisDevice
    """Drive or servo."""
    increments: float
    """Increments in one m or rad; negative where the device counts the other way."""
    low: float
    high: float
    """Limits in m or rad."""
    plausible: tuple[float, float]
    """Lowest and highest position in m or rad that its encoder may read: limits, home and lag."""
    velocity: float
    acceleration: float
    """Of its profile in m/s and m/s², or rad/s and rad/s²; for the longest time of a way."""
    unit: str
    shown: float
    """Unit of messages, and how many of it are one m or rad."""

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

        Raises AxisLimitExceeded if it is no number or outside the limits of the axis.
        """
        if not self.low <= position <= self.high:
            raise AxisLimitExceeded(
                f"axis {self.name} was asked for {self.in_words(position)}, its limits are "
                f"{self.in_words(self.low)} to {self.in_words(self.high)}; nothing has moved"
            )
        return round(position * self.increments)

    def in_words(self, position: float) -> str:
        """Return a position with its unit."""
        return f"{position * self.shown:.2f} {self.unit}"

    def longest_s(self, way: float) -> float:
        """Return the longest time in s that a way in m or rad may take."""
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
        """Whether the axes are enabled and know their positions: no motion begins with homing."""
        return self._ready

    def inspect(self) -> dict[str, str | MotionError]:
        """Return for each axis what its device is doing, or what is wrong; nothing moves."""
        found: dict[str, str | MotionError] = {}
        for axis in self._axes.values():
            try:
                found[axis.device.name] = axis.device.identify()
            except MotionError as error:
                found[axis.device.name] = error
        return found

    def clear_faults(self, *, reboot: bool) -> None:
        """Clear the faults of all devices, also those of an earlier program; nothing moves.

        Raises MotionError if a device does not answer or stays at fault.

        Parameters
        ----------
        reboot
            True to restart servos at fault, which drop what they carry.
        """
        self._ready = False
        for axis in self._axes.values():
            axis.device.clear_fault(reboot=reboot)

    def move(
        self, targets: Mapping[str, float], supervise: Callable[[], None] = unwatched
    ) -> dict[str, float]:
        """Move to positions in m or rad by axis; return the positions that were reached.

        The first motion, and the first one after a fault, prepares the devices: it enables them and
        finds their homes, one axis after the other. A fault of a device is cleared only when it was
        raised before: whoever moves again has seen it. Raises AxisLimitExceeded if a target is
        outside its limits; nothing has moved. Raises PositionNotReached if a way takes too long;
        all axes were stopped. Raises MotionError if a device is at fault or silent. All axes were
        stopped, and are prepared anew.

        What ``supervise`` raises stops all axes too; they know their positions then, and go on from
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
            # Two drives with one node-ID show as anything: a boot-up, a fault, a wrong state.
            found = self.inspect().values()
            cause = next((one for one in found if isinstance(one, AxisDuplicated)), error)
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
        # Those that have arrived are asked on: one that fails then stops the others too.
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
        """Stop all axes at once, wait until they stand, and return in words which do."""
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
    """Return a supervision that goes on while axes are stopped, whatever it raises."""

    def guarded() -> None:
        # The stop of the axes comes first; what was raised before is what ends the motion.
        with suppress(Exception):
            supervise()

    return guarded
