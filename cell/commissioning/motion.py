"""Motions that a person watches: shown while they run, and stopped where the person leaves."""

from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Self

from cell.commissioning.engine import LIVE_CALL_S, Dialog, Left, StepFailed
from gripper.errors import GraspStopped
from gripper.state import Cycle
from tactile.frames.codec import TactileFrame


class WatchedMotion:
    """Shows opening and force while fingers move; within ``with`` a person who leaves stops them.

    Empty fingers then stand where they are; a part that is held stays held. It is the watch of the
    commands. ``request_stop`` lets the running command end with GraspStopped.
    """

    def __init__(self, dialog: Dialog, request_stop: Callable[[], None]) -> None:
        self._dialog = dialog
        self._request_stop = request_stop
        self._left: Left | None = None
        self._due_s = 0.0
        self.cycles: list[Cycle] = []
        self.frames: list[TactileFrame] = []
        """Periods of the loop and tactile frames of all motions so far."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        ends = error is None or isinstance(error, GraspStopped | StepFailed)
        if self._left is not None and ends:
            raise self._left from None

    def __call__(self, cycle: Cycle, frames: Sequence[TactileFrame] = ()) -> None:
        """Keep one period of the loop, and show it where the last one shown is old enough."""
        self.cycles.append(cycle)
        self.frames += frames
        if self._left is not None or cycle.t_s < self._due_s:
            return
        self._due_s = cycle.t_s + LIVE_CALL_S
        force = "" if cycle.force is None else f"{min(cycle.force.force_n):.2f} N, "
        try:
            self._dialog.live("grip", f"{force}opening {1e3 * cycle.state.aperture_m:.1f} mm")
        except Left as left:
            self._left = left
            self._request_stop()
