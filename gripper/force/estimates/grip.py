"""State of one grip that control and supervision share, with the stiffness of its part."""

from collections import deque
from dataclasses import dataclass, field
from math import inf, sqrt

from gripper.dynamixel.drive import SIGMAS
from gripper.force.certainty import EMPTY_SHARE, RUN_STEPS
from gripper.force.loop import Moment
from gripper.mechanics.transmission import Mechanics
from gripper.settings import GripperSettings
from gripper.values.force_sensor import LEAST_SAMPLES, ONE_FRAME_S

_KEPT_S = 0.64
"""Time in s for which values are kept: several times the delay of a sensor. [chosen]"""
KNOWN_N = 3.0
"""Force in N from which a stiffness is known well; it is measured anew each 0.7 N. [tuned]"""
_SLOPE_N = 0.7
"""Growth of the force in N for one stiffness: several times the noise. [tuned]"""
_HARDENS = 5.0
"""Factor by which foam may be harder at the next travel, or a part that the fingers meet at speed.
[assumed]"""
SOFTEST_N_M, STIFFEST_N_M = 200.0, 5e4
"""Stiffness in N/m of the softest and of the hardest part between the pads: foam, and steel.
[chosen]"""


class History:
    """Values of the last periods by time."""

    def __init__(self) -> None:
        self._entries: deque[tuple[float, float]] = deque()
        self._shift = 0.0

    def __bool__(self) -> bool:
        return bool(self._entries)

    def add(self, now_s: float, value: float) -> None:
        """Add the value of now; those that are too old are discarded."""
        self._entries.append((now_s, value - self._shift))
        # The value at the time of the oldest one that is kept may be from before it.
        while len(self._entries) > 1 and self._entries[1][0] <= now_s - _KEPT_S:
            self._entries.popleft()

    @property
    def newest(self) -> float:
        """The value that was added last."""
        return self._entries[-1][1] + self._shift

    def at(self, t_s: float) -> float:
        """Return the value at a time in s; the oldest one where the time is before it."""
        for then_s, value in reversed(self._entries):
            if then_s <= t_s:
                return value + self._shift
        return self._entries[0][1] + self._shift

    def most(self, *, since_s: float) -> float:
        """Return the largest value since a time in s, at least the newest one."""
        recent = [value for then_s, value in self._entries if then_s >= since_s]
        return max(recent, default=self._entries[-1][1]) + self._shift

    def shift(self, by: float) -> None:
        """Add ``by`` to all values."""
        self._shift += by


class StiffnessEstimate:
    """Stiffness of the gripped part: growth of the grip force over travel, from the touch on.

    The travel is known within the resolution of the opening, so the stiffness has a least and a
    largest value (set-membership identification, Milanese and Vicino 1991). A hard part yields
    less than that resolution: it has no upper bound.

    Parameters
    ----------
    mechanics
        Of the gripper.
    """

    def __init__(self, mechanics: Mechanics) -> None:
        self.step_m = max(mechanics.opening_steps_m())
        """Resolution of the opening in m: the largest count of a servo."""
        self._touch_n = EMPTY_SHARE * mechanics.settings.contact_force_n
        self.apertures = History()
        """Opening of the last periods in m."""
        self._block: list[tuple[float, float]] = []
        self._block_s, self._block_m = -inf, 0.0
        self._pairs: deque[tuple[float, float]] = deque(maxlen=LEAST_SAMPLES)
        self._anchor: tuple[float, float] | None = None
        self._sample_s: float | None = None
        self.stiffness_n_m: float | None = None
        """Growth of the grip force for each m of closing; None before it was measured."""
        self.bounds_n_m = SOFTEST_N_M, STIFFEST_N_M
        """Least and largest stiffness by the resolution of the opening."""
        self._most_n_m = STIFFEST_N_M

    def push(self, moment: Moment) -> None:
        """Add the present opening and the newest sample, which may be the same as before."""
        self.apertures.add(moment.now_s, moment.state.aperture_m)
        sample = moment.sample
        if sample is None or not sample.valid or sample.t_s == self._sample_s:
            return
        self._sample_s = sample.t_s
        self._block.append((sample.grip_n, self.apertures.at(sample.measured_s)))
        if sample.t_s - self._block_s < ONE_FRAME_S:
            return
        n = len(self._block)
        pair = (sum(row[0] for row in self._block) / n, sum(row[1] for row in self._block) / n)
        # A sensor is read once in a period: the time of a sample is known to one of them.
        way_m = abs(pair[1] - self._block_m) * moment.dt_s / (sample.t_s - self._block_s)
        self._block_s, self._block_m = sample.t_s, pair[1]
        self._block.clear()
        if pair[0] < self._touch_n:
            self._anchor = pair
            self._pairs.clear()
            self.bounds_n_m = SOFTEST_N_M, STIFFEST_N_M
            return
        self._pairs.append(pair)
        if self._anchor is None:
            return
        # The anchor is a mean of several blocks.
        noise_n = SIGMAS * sample.noise_n * sqrt((1.0 + 1.0 / LEAST_SAMPLES) / n)
        self._bound(pair[0] - self._anchor[0], self._anchor[1] - pair[1], noise_n, way_m)
        if len(self._pairs) < LEAST_SAMPLES:
            return
        mean_n = sum(pair[0] for pair in self._pairs) / LEAST_SAMPLES
        mean_m = sum(pair[1] for pair in self._pairs) / LEAST_SAMPLES
        growth_n, travel_m = mean_n - self._anchor[0], self._anchor[1] - mean_m
        if growth_n >= _SLOPE_N:
            self.stiffness_n_m = min(growth_n / max(travel_m, self.step_m), STIFFEST_N_M)
            if travel_m >= RUN_STEPS * self.step_m:
                self._anchor = mean_n, mean_m
                self.allow_harder()

    def _bound(self, growth_n: float, travel_m: float, noise_n: float, way_m: float) -> None:
        """Reduce the bounds by a growth of the force; where it contradicts them, they follow it.

        ``way_m``: way in m of the time by which the force may be younger than its opening.
        """
        least_n_m, most_n_m = self.bounds_n_m
        if growth_n > noise_n:
            shown_n_m = (growth_n - noise_n) / (max(travel_m, 0.0) + way_m + self.step_m)
            least_n_m = min(max(least_n_m, shown_n_m), STIFFEST_N_M)
            most_n_m = max(least_n_m, most_n_m)
        if travel_m > self.step_m and growth_n > -noise_n:
            # A growth below the noise may be as large as that.
            shown_n_m = (max(growth_n, noise_n) + noise_n) / (travel_m - self.step_m)
            most_n_m = max(min(most_n_m, shown_n_m), SOFTEST_N_M)
            least_n_m = min(least_n_m, most_n_m)
        self.bounds_n_m = least_n_m, most_n_m

    def allow_harder(self) -> None:
        """Raise the upper bound for a travel that is to follow."""
        least_n_m, self._most_n_m = self.bounds_n_m
        self.bounds_n_m = least_n_m, min(_HARDENS * self._most_n_m, STIFFEST_N_M)

    def end(self) -> None:
        """Take the bounds of the travel so far."""
        least_n_m, most_n_m = self.bounds_n_m
        self.bounds_n_m = least_n_m, max(least_n_m, min(most_n_m, self._most_n_m))


@dataclass(slots=True, kw_only=True)
class Grip:
    """State of one grip, and the set-points of its control."""

    mechanics: Mechanics
    """Of the gripper."""
    stiffness: StiffnessEstimate
    """Stiffness of the part; only the first ramp updates it, a squeeze does not."""
    touch_m: float
    """Opening in m at which both pads were first loaded: the fingers are not driven open beyond it,
    however much force the pads report."""
    carried_s: float = inf
    """Time in s from which no push opens the fingers, until the set-point changes: a carried part
    does not grow, but the zero of a pad may drift."""
    opened_s: float = -inf
    """Monotonic time in s of the last push that opens the fingers."""
    force_n: float
    balance_n: float = field(init=False)
    """Estimated grip force in N, and the drive in N that balances it without friction."""
    setpoint_n: float = field(init=False)
    """Set-point of the grip force in N in the last period."""
    planned_n: float = field(init=False)
    rate_n_s: float = 0.0
    """Commanded force in N now, on the way to the set-point, and its rate in N/s."""
    drive_n: float = field(init=False)
    """Driving force of the last period in N. It opens below 0."""

    def __post_init__(self) -> None:
        self.setpoint_n = self.planned_n = self.balance_n = self.drive_n = self.force_n

    @property
    def settings(self) -> GripperSettings:
        """Settings of the gripper."""
        return self.mechanics.settings
