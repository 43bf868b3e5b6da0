"""Timing statistics of the loop, in bounded memory."""

from collections import Counter
from dataclasses import dataclass, field
from math import log10

_FIRST_S = 1e-6
"""Upper edge of the first bin in s. [chosen]"""
_PER_DECADE, _MOST = 40, 1e7
"""Bins for each factor of ten, each 6 % wide, and the last one over the first: 10 s. [chosen]"""
LATE_SHARE = 0.5
"""Delay of a period, as a share of its length, above which it counts as late. [chosen]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Distribution:
    """Quantiles of durations; they are upper edges of bins 6 % wide, the largest is exact."""

    n: int = 0
    """Durations counted."""
    p50_s: float = 0.0
    p99_s: float = 0.0
    p999_s: float = 0.0
    """Durations in s that 50, 99 and 99.9 % do not exceed; 0 where there are none."""
    max_s: float = 0.0
    """The longest in s."""


class Histogram:
    """Histogram of durations in bins evenly spaced on a logarithmic scale from 1 us to 10 s."""

    def __init__(self) -> None:
        self._counts: Counter[int] = Counter()
        self._max_s = 0.0

    def add(self, duration_s: float) -> None:
        """Count one duration in s; less than 1 us, or below 0, counts as 1 us."""
        within = min(max(duration_s / _FIRST_S, 1.0), _MOST)
        self._counts[int(_PER_DECADE * log10(within)) + (within > 1.0)] += 1
        self._max_s = max(self._max_s, duration_s)

    def distribution(self) -> Distribution:
        """Return what was counted."""
        n, seen = self._counts.total(), 0
        edges_s: list[float] = []
        shares = [0.5, 0.99, 0.999]
        for place in sorted(self._counts):
            seen += self._counts[place]
            edge_s = min(self._max_s, _FIRST_S * 10.0 ** (place / _PER_DECADE))
            edges_s += [edge_s for share in shares[len(edges_s) :] if seen >= share * n]
        p50_s, p99_s, p999_s = edges_s or (0.0, 0.0, 0.0)
        return Distribution(n=n, p50_s=p50_s, p99_s=p99_s, p999_s=p999_s, max_s=self._max_s)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopStatistics:
    """Timing of the loop since the gripper was made."""

    cycles: int = 0
    """Periods that were run."""
    overruns: int = 0
    """Periods whose work was not done when the next one was due."""
    late: int = 0
    """Periods that began more than half a period late."""
    missed_reads: int = 0
    """Periods without feedback; nothing was written in them."""
    derated: int = 0
    """Periods in which the heat of a winding lowered the cap of the current."""
    lateness: Distribution = field(default_factory=Distribution)
    """Lateness of the start of each period."""
    transaction: Distribution = field(default_factory=Distribution)
    """Duration of reading the feedback of all servos."""
    sensor_age: Distribution = field(default_factory=Distribution)
    """Age of the newest force sample when a step of control used it."""


class LoopTimer:
    """Collector of the timing of a loop.

    Parameters
    ----------
    period_s
        Period of the loop in s.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._lateness = Histogram()
        self.transaction = Histogram()
        """Duration of reading the feedback in s."""
        self.sensor_age = Histogram()
        """Age of the force sample of a step in s."""
        self._overruns = self._late = 0
        self.missed_reads = self.derated = 0
        self.overruns_in_row = 0
        """Overruns since the last period in time."""

    def work_done(self, late_s: float, *, counts: bool) -> None:
        """Count a period whose work ended ``late_s`` s after the next was due; 0 is in time.

        Parameters
        ----------
        late_s
            Time beyond the period in s.
        counts
            False if the time was a wait for a missing answer: this is a fault of the bus, which has
            its own limit.
        """
        if late_s <= 0.0:
            self.overruns_in_row = 0
            return
        self._overruns += 1
        self.overruns_in_row += counts

    def began(self, late_s: float) -> None:
        """Count a period that began ``late_s`` s late."""
        self._lateness.add(late_s)
        self._late += late_s > LATE_SHARE * self._period_s

    def statistics(self) -> LoopStatistics:
        """Return what was counted."""
        lateness = self._lateness.distribution()
        return LoopStatistics(
            cycles=lateness.n,
            overruns=self._overruns,
            late=self._late,
            missed_reads=self.missed_reads,
            derated=self.derated,
            lateness=lateness,
            transaction=self.transaction.distribution(),
            sensor_age=self.sensor_age.distribution(),
        )
