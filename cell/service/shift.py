"""The ledger of a shift: parts, their answers and grasps since the service began, bounded."""

import statistics
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from cell.plugin.part_report import PartReport

KEPT_ANSWERS = 20
"""Newest answers that are kept, each with its last grasp."""
_KEPT_TIMES = 1000
"""Newest parts whose times are kept."""
_RATE_S = 3600.0
"""Time in s up to now over which parts are counted for their rate."""


class Shift:
    """Counts the parts that a cell has identified and sorted; every method from any thread."""

    def __init__(self, wall_clock: Callable[[], float] = time.time) -> None:
        self._now_s = wall_clock
        self._since_s = wall_clock()
        self._counts: Counter[str] = Counter()
        self._n_rejected = self._n_missed = 0
        self._cycles_s: deque[float] = deque(maxlen=_KEPT_TIMES)
        self._times_s: deque[float] = deque(maxlen=_KEPT_TIMES)
        # Replaced as a whole with each part: who reads it needs no lock.
        self._answers: tuple[tuple[dict[str, Any], dict[str, Any] | None], ...] = ()

    def add(self, report: PartReport) -> None:
        """Count a part, or a turn without one."""
        answer = report.answer
        if answer is None:
            self._n_missed += 1
            return
        self._n_rejected += report.rejected
        self._times_s.append(self._now_s())
        self._cycles_s.append(report.seconds)
        others = [(p, label) for label, p in answer.probabilities.items() if label != answer.label]
        second = max(others, default=None)
        shape = answer.shape
        entry = {
            "id": self._counts.total() + 1,
            "time_s": self._times_s[-1],
            "task": report.task,
            "label": answer.label,
            "probability": answer.probability,
            "runner_up": second and {"label": second[1], "probability": second[0]},
            "shape": None if shape is None else shape.kind,
            "size_mm": None if shape is None else shape.size_mm,
            "interval_mm": None if shape is None else shape.interval_mm,
            "n_grasps": answer.n_grasps,
            "seconds": report.seconds,
            "place": report.place,
        }
        self._counts[answer.label] += 1
        self._answers = (*self._answers, (entry, report.curves))[-KEPT_ANSWERS:]

    def values(self, *, n_faults: int) -> dict[str, Any]:
        """Return the ledger as plain data; times in s, the rate in parts an hour."""
        cycles_s, recent_s = tuple(self._cycles_s), tuple(self._times_s)
        now_s = self._now_s()
        begin_s = max(now_s - _RATE_S, self._since_s)
        if len(recent_s) == _KEPT_TIMES:
            begin_s = max(begin_s, recent_s[0])
        n_recent = sum(at_s > begin_s for at_s in recent_s)
        return {
            "since_s": self._since_s,
            "parts": self._counts.total(),
            "rejected": self._n_rejected,
            "missed": self._n_missed,
            "faults": n_faults,
            "cycle_s": statistics.median(cycles_s) if cycles_s else None,
            "parts_per_hour": 3600.0 * n_recent / (now_s - begin_s) if n_recent else None,
            "counts": dict(self._counts),
            "answers": [entry for entry, _ in self._answers],
        }

    def grasp(self, number: int) -> dict[str, Any] | None:
        """Return the curves of an answer by its id; None where they are no longer kept."""
        return next((curves for one, curves in self._answers if one["id"] == number), None)
