"""Totals since the service began, for metrics: parts, cycle times, force errors."""

from collections import Counter
from collections.abc import Iterator
from itertools import accumulate
from math import inf

from cell.control.answer import Answer
from cell.control.identification import Identification
from recognition.recognizer import UNKNOWN

_CYCLES_S = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0, 20.0, 30.0, 60.0)
"""Upper edges of the classes of cycle times in s."""
_ERRORS_N = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Upper edges of the classes of force errors in N."""


class Distribution:
    """Counts values in classes; each class includes its upper edge."""

    def __init__(self, edges: tuple[float, ...]) -> None:
        self._edges = (*edges, inf)
        self._counts = [0] * len(self._edges)
        self.sum = 0.0
        """Sum of all values."""

    def add(self, value: float) -> None:
        """Count one value."""
        self._counts[next(n for n, edge in enumerate(self._edges) if value <= edge)] += 1
        self.sum += value

    def cumulated(self) -> Iterator[tuple[float, int]]:
        """Yield each edge with the number of values up to it; the last edge is inf."""
        return zip(self._edges, accumulate(self._counts), strict=True)


class Totals:
    """Growing totals; one thread adds, any thread reads."""

    def __init__(self) -> None:
        self.parts: Counter[tuple[str, str]] = Counter()
        """Parts by label and result: ``named``, ``unknown``, ``rejected`` (named, but released at
        the place of the rejects) or ``missed`` (no part found; without label)."""
        self.cycles_s = Distribution(_CYCLES_S)
        """Time of each part in s, as `Answer.seconds`."""
        self.force_errors_n = Distribution(_ERRORS_N)
        """Distance in N between force and set-point at the end of each grasp of a part."""

    def add(self, answer: Answer, found: Identification | None) -> None:
        """Count a part with its grasps, or a turn without a part."""
        if not answer.label:
            self.parts["", "missed"] += 1
            return
        named = "rejected" if answer.rejected else "named"
        self.parts[answer.label, "unknown" if answer.label == UNKNOWN else named] += 1
        self.cycles_s.add(answer.seconds)
        for record in () if found is None else found.records:
            wanted_n = record.cycles[-1].setpoint_n
            self.force_errors_n.add(abs(record.outcome.final_force_n - wanted_n))
