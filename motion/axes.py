"""Axes in m and rad: motion of several axes together, the stop of all of them."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from motion.axis import POLL_S, Axis
from motion.bus import Watch, unwatched
from motion.errors import AxisDuplicated, MotionError, PositionNotReached

_STOP_S = 0.2
"""Longest time in s of a stop in addition to braking: for the command and the settling."""


class Axes:
    """All axes of a positioner, moved together and stopped together."""

    def __init__(self, axes: Sequence[Axis], watch: Watch) -> None:
        self._axes = {axis.name: axis for axis in axes}
        self._watch = watch
        self.ready = False
        """Whether the axes are enabled and homed, so that no motion begins with homing."""
        self._reported = False

    def inspect(self) -> dict[str, str | MotionError]:
        """Return the state or the error of each device by axis; nothing moves."""
        states: dict[str, str | MotionError] = {}
        for axis in self._axes.values():
            try:
                states[axis.label] = axis.identify()
            except MotionError as error:
                states[axis.label] = error
        return states

    def clear_faults(self, *, reboot: bool) -> None:
        """Clear the faults of all devices, also those of an earlier program; nothing moves.

        Raises MotionError if a device does not answer or stays at fault.

        Parameters
        ----------
        reboot
            True to restart servos at fault, which drop their load.
        """
        self.ready = False
        for axis in self._axes.values():
            axis.clear_fault(reboot=reboot)

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
            if not isinstance(error, MotionError):
                raise
            self.ready, self._reported = False, True
            # Two drives with one node-ID cause many errors: a boot-up, a fault, a wrong state.
            states = self.inspect().values()
            cause = next((state for state in states if isinstance(state, AxisDuplicated)), error)
            if not isinstance(cause, PositionNotReached):
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
                raise PositionNotReached(
                    f"after {longest_s:.1f} s {where}: is something in its way?"
                )
            self._watch.pause(POLL_S)
        for axis in moved:
            axis.rest()
        return {axis.name: axis.position for axis in moved}

    def stop(self) -> str:
        """Stop all axes at once, wait until they stand, and return the result as text."""
        moving = list(self._axes.values())
        for axis in moving:
            with suppress(MotionError):
                axis.stop()
        self._watch.supervise = _undisturbed(self._watch.supervise)
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
    except MotionError:
        return False


def _undisturbed(supervise: Callable[[], None]) -> Callable[[], None]:
    """Return a supervision for the stop of axes, without its errors."""

    def guarded() -> None:
        # The stop of the axes has priority; the earlier error ends the motion.
        with suppress(Exception):
            supervise()

    return guarded
