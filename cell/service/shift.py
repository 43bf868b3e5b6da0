"""The ledger of a shift, bounded, and the totals of this program: parts, faults, cycle times."""

import statistics
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from cell.control.identification import Identification
from cell.control.part import Part
from cell.errors import RequestRefused
from recognition.recognizer import UNKNOWN

MOST_ANSWERS = 20
"""Number of newest answers that are kept, each with its last grasp."""
_MOST_CYCLES = 1000
"""Number of newest parts whose cycle times are kept."""
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
        self._times_s = deque[float]()
        self.parts: tuple[Part, ...] = ()
        """The newest parts, at most `MOST_ANSWERS`, oldest first; replaced with each part."""
        self._curves: dict[int, Mapping[str, Any] | None] = {}
        self._begin(wall_clock(), 0)

    def _begin(self, since_s: float, n_faults: int) -> None:
        self.began_s = began_s(self._now_s(), self._begins_h)
        """Unix time in s at which the shift began, by the clock on the wall."""
        self._since_s, self._faults_before = since_s, n_faults
        self._counts = Counter[str]()
        self._n_rejected = self._n_missed = 0
        self._cycles_s = deque[float](maxlen=_MOST_CYCLES)

    def _look(self, n_faults: int) -> None:
        """Begin a new shift when its hour has come."""
        if (now_s := began_s(self._now_s(), self._begins_h)) != self.began_s:
            self._begin(now_s, n_faults)

    def add(self, part: Part, curves: Mapping[str, Any] | None = None) -> None:
        """Count a part and keep the curves of its last grasp, or count a turn without a part."""
        n_faults = self._n_faults()
        with self._lock:
            self._look(n_faults)
            if not part.label:
                self._n_missed += 1
                return
            self._count(part.label, part.rejected, part.seconds, part.time_s)
            self.parts = (*self.parts, part)[-MOST_ANSWERS:]
            self._curves[part.number] = curves
            if len(self._curves) > MOST_ANSWERS:
                del self._curves[next(iter(self._curves))]

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
        """Return the ledger, with its newest parts as ``answers``; times in s."""
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
                "answers": list(self.parts),
            }

    def part(self, number: int) -> Part:
        """Return a part by its number. Raises RequestRefused if it is not kept."""
        for part in self.parts:
            if part.number == number:
                return part
        newest = self.parts[-1].number if self.parts else 0
        raise RequestRefused(
            f"part {number} is not kept; the newest is {newest}, and {MOST_ANSWERS} are kept"
        )

    def curves(self, number: int) -> Mapping[str, Any] | None:
        """Return the last grasp of a part by its number; None if it is not kept."""
        return self._curves.get(number)


def began_s(now_s: float, begins_h: Sequence[float]) -> float:
    """Return the unix time in s at which the shift of a moment began.

    ``begins_h`` are hours of the local day; the night shift begins on the day before.
    """
    now = datetime.fromtimestamp(now_s)
    midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
    begins = (midnight + timedelta(hours=hour - 24.0 * day) for hour in begins_h for day in (0, 1))
    return max(begin for begin in begins if begin <= now).timestamp()


@dataclass(slots=True)
class Sum:
    """Number and sum of values."""

    n: int = 0
    sum: float = 0.0

    def add(self, value: float) -> None:
        """Count one value."""
        self.n += 1
        self.sum += value


class Totals:
    """Totals since the start of the program; one thread adds, any thread reads."""

    def __init__(self) -> None:
        self.parts: Counter[tuple[str, str]] = Counter()
        """Parts by label and result: ``named``, ``unknown``, ``rejected`` (named, but released at
        the place of the rejects) or ``missed`` (no part found; without label)."""
        self.cycles_s = Sum()
        """Time of each part in s, as `Part.seconds`."""
        self.force_errors_n = Sum()
        """Distance in N between force and set-point at the end of each grasp of a part."""

    def add(self, part: Part, identification: Identification | None) -> None:
        """Count a part with its grasps, or a turn without a part."""
        if not part.label:
            self.parts["", "missed"] += 1
            return
        named = "rejected" if part.rejected else "named"
        self.parts[part.label, "unknown" if part.label == UNKNOWN else named] += 1
        self.cycles_s.add(part.seconds)
        for record in () if identification is None else identification.records:
            wanted_n = record.cycles[-1].setpoint_n
            self.force_errors_n.add(abs(record.outcome.final_force_n - wanted_n))
