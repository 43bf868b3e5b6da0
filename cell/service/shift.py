"""The ledger of a shift, bounded: its parts and faults, and the newest answers of this program."""

import statistics
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from typing import Any

from cell.control.answer import Answer

KEPT_ANSWERS = 20
"""Number of newest answers that are kept, each with its last grasp."""
_KEPT_CYCLES = 1000
"""Number of newest parts whose cycle times are kept."""
_SHOWN = (
    *("number", "time_s", "task", "label", "label_id", "probability", "runner_up"),
    *("n_grasps", "seconds", "place", "place_id"),
)
"""Values of a part in the ledger."""
_HOUR_S = 3600.0
"""Time in s before now in which recent parts are counted."""


class Shift:
    """Counts the parts that a cell has identified and sorted; every method from any thread.

    Parameters
    ----------
    begins_h
        Hours of the local day at which a shift begins.
    n_faults
        Returns the faults since the program began.
    wall_clock
        Returns the unix time in s.
    """

    def __init__(
        self,
        begins_h: Sequence[float] = (0.0,),
        n_faults: Callable[[], int] = lambda: 0,
        wall_clock: Callable[[], float] = time.time,
    ) -> None:
        self._begins_h, self._n_faults, self._now_s = begins_h, n_faults, wall_clock
        self._lock = threading.Lock()
        self._started_s = wall_clock()
        self._number = 0
        self._times_s = deque[float]()
        self.parts: tuple[Answer, ...] = ()
        """The newest parts, at most `KEPT_ANSWERS`, oldest first; replaced with each part."""
        self._begin(wall_clock(), 0)

    def _begin(self, since_s: float, n_faults: int) -> None:
        self.began_s = began_s(self._now_s(), self._begins_h)
        """Unix time in s at which the shift began, by the clock on the wall."""
        self._since_s, self._faults_before = since_s, n_faults
        self._counts = Counter[str]()
        self._n_rejected = self._n_missed = 0
        self._cycles_s = deque[float](maxlen=_KEPT_CYCLES)

    def _look(self, n_faults: int) -> None:
        """Begin a new shift when its hour has come."""
        if (now_s := began_s(self._now_s(), self._begins_h)) != self.began_s:
            self._begin(now_s, n_faults)

    def add(self, answer: Answer) -> None:
        """Count a part, or a turn without one."""
        n_faults = self._n_faults()
        with self._lock:
            self._look(n_faults)
            if not answer.label:
                self._n_missed += 1
                return
            self._number += 1
            part = replace(answer, number=self._number, time_s=self._now_s())
            self._count(part.label, part.rejected, part.seconds, part.time_s)
            self.parts = (*self.parts, part)[-KEPT_ANSWERS:]

    def _count(self, label: str, rejected: bool, seconds: float, time_s: float) -> None:
        self._n_rejected += rejected
        self._cycles_s.append(seconds)
        self._counts[label] += 1
        self._times_s.append(time_s)
        self._forget_times()

    def _forget_times(self) -> None:
        """Forget the times before the last hour, and those after now: the clock was set back."""
        now_s = self._now_s()
        while self._times_s and not now_s - _HOUR_S < self._times_s[0] <= now_s:
            self._times_s.popleft()

    def add_earlier(self, rows: Sequence[Mapping[str, Any]]) -> None:
        """Count the rows of the history that earlier programs have written in the same shift."""
        with self._lock:
            rows = [row for row in rows if row["time_s"] >= self.began_s]
            self._since_s = min((self._since_s, *(row["time_s"] for row in rows)))
            self._n_missed += sum(row["kind"] == "miss" for row in rows)
            self._faults_before -= sum(row["kind"] == "fault" for row in rows)
            own_s, self._times_s = self._times_s, deque()
            for row in (one for one in rows if one["kind"] == "part"):
                self._count(row["label"], bool(row["rejected"]), row["seconds"], row["time_s"])
            self._times_s += own_s

    def values(self) -> dict[str, Any]:
        """Return the ledger as plain data; times in s."""
        n_faults = self._n_faults()
        with self._lock:
            self._look(n_faults)
            self._forget_times()
            return {
                "since_s": self._since_s,
                "started_s": self._started_s,
                "parts": self._counts.total(),
                "rejected": self._n_rejected,
                "missed": self._n_missed,
                "faults": n_faults - self._faults_before,
                "cycle_s": statistics.median(self._cycles_s) if self._cycles_s else None,
                "parts_last_hour": len(self._times_s),
                "counts": dict(self._counts),
                "answers": [part_values(part) for part in self.parts],
            }

    def part(self, number: int) -> Answer | None:
        """Return a part by its number; None if it is no longer kept."""
        return next((part for part in self.parts if part.number == number), None)


def part_values(part: Answer) -> dict[str, Any]:
    """Return a part as plain data, without its curves; lengths in mm."""
    shape = part.shape
    return {name: getattr(part, name) for name in _SHOWN} | {
        "shape": part.kind or None,
        "size_mm": part.size_mm or None,
        "interval_mm": shape and (1e3 * shape.low_m, 1e3 * shape.high_m),
    }


def began_s(now_s: float, begins_h: Sequence[float]) -> float:
    """Return the unix time in s at which the shift of a moment began.

    ``begins_h`` are hours of the local day; the night shift begins on the day before.
    """
    now = datetime.fromtimestamp(now_s)
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    begins = (midnight + timedelta(hours=hour - 24.0 * day) for hour in begins_h for day in (0, 1))
    return max(begin for begin in begins if begin <= now).timestamp()
