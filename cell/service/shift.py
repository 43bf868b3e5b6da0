"""The ledger of a shift: parts, their answers and grasps since the service began, bounded."""

import statistics
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from cell.plugin.part_report import PartReport

KEPT_ANSWERS = 20
"""Number of newest answers that are kept, each with its last grasp."""
_KEPT_CYCLES = 1000
"""Number of newest parts whose cycle times are kept."""
_HOUR_S = 3600.0
"""Time in s before now in which recent parts are counted."""


class Shift:
    """Counts the parts that a cell has identified and sorted; every method from any thread."""

    def __init__(self, wall_clock: Callable[[], float] = time.time) -> None:
        self._now_s = wall_clock
        self._since_s = wall_clock()
        self._counts: Counter[str] = Counter()
        self._n_rejected = self._n_missed = 0
        self._cycles_s: deque[float] = deque(maxlen=_KEPT_CYCLES)
        self._times_s = deque[float]()
        self.parts: tuple[PartReport, ...] = ()
        """The newest parts, at most `KEPT_ANSWERS`, oldest first; replaced with each part."""

    def add(self, report: PartReport) -> None:
        """Count a part, or a turn without one."""
        if report.answer is None:
            self._n_missed += 1
            return
        self._n_rejected += report.rejected
        self._cycles_s.append(report.seconds)
        self._counts[report.answer.label] += 1
        part = replace(report, number=self._counts.total(), time_s=self._now_s())
        self._times_s.append(part.time_s)
        while self._times_s[0] <= part.time_s - _HOUR_S:
            self._times_s.popleft()
        self.parts = (*self.parts, part)[-KEPT_ANSWERS:]

    def values(self, *, n_faults: int) -> dict[str, Any]:
        """Return the ledger as plain data; times in s."""
        cycles_s, begin_s = tuple(self._cycles_s), self._now_s() - _HOUR_S
        return {
            "since_s": self._since_s,
            "parts": self._counts.total(),
            "rejected": self._n_rejected,
            "missed": self._n_missed,
            "faults": n_faults,
            "cycle_s": statistics.median(cycles_s) if cycles_s else None,
            "parts_last_hour": sum(at_s > begin_s for at_s in tuple(self._times_s)),
            "counts": dict(self._counts),
            "answers": [part.as_json() for part in self.parts],
        }

    def part(self, number: int) -> PartReport | None:
        """Return a part by its number; None if it is no longer kept."""
        return next((part for part in self.parts if part.number == number), None)
