"""The watch of a motion: it records each period, obeys a stop, and collects the frames."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from cell.control.journal import Journal
from cell.control.lifecycle import CellLifecycle
from cell.control.records import GraspCollector
from cell.hand.interface import OnPeriod
from gripper.values.state import Cycle
from recognition.grasp import SERIES_PAUSE_MS, PadArray, SelfZero
from tactile.source import TactileFrame


@dataclass
class MotionWatch:
    """Watches each period of a motion of the hand."""

    life: CellLifecycle
    """Has requested stops and the states to record."""
    journal: Journal
    pads: PadArray
    source: str
    """As in `recognition.grasp.Grasp`."""
    _last_start_ms: int = 0

    def period(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        """Record one period with its frames; obey a stop. A lost recording may be a fault."""
        self._record(cycle, frames)
        self.journal.check()

    def motion(self, cycle: Cycle, _frames: Sequence[TactileFrame]) -> None:
        """Record one period without its frames; obey a stop. A lost recording ends no release."""
        self._record(cycle, ())

    def _record(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        self.life.progressed_s = time.monotonic()
        self.life.check_cancelled()
        self.journal.states(self.life.state, self.life.grasp_state)
        self.journal.cycle(cycle, frames)

    def collecting(self, zero: SelfZero | None = None) -> tuple[GraspCollector, OnPeriod]:
        """Return a collector for a motion that begins now, and the callback that fills it."""
        # The grasps stay in order if the machine's clock is set back by less than an hour. More
        # corrects a wrong day.
        now_ms, next_ms = time.time_ns() // 1_000_000, self._last_start_ms + 1
        self._last_start_ms = next_ms if now_ms < next_ms < now_ms + SERIES_PAUSE_MS else now_ms
        collector = GraspCollector(
            self.pads, source=self.source, start_ms=self._last_start_ms, zero=zero
        )

        def watch(cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
            self.period(cycle, frames)
            collector.add(cycle, frames)

        return collector, watch
