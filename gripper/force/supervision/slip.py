"""Detection of a held part that slips: by its force, the travel of the fingers, or its position."""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from math import exp, hypot, inf, sqrt
from statistics import fmean
from typing import NamedTuple

from gripper.errors import PartSlipped
from gripper.force.certainty import BRIEF_S, PRESENT_SHARE, RECOVERED_S, STEADY_S, YOUNG_S
from gripper.force.loop import Moment
from gripper.force.supervision.part_watch import CREEP_M
from gripper.settings import GripperSettings
from gripper.values.force_sensor import FRAME_S, ForceSample, RecentForce

_USUAL_TIME_S = 0.6
"""Time constant in s of the usual force, from which a drop is measured. [tuned]"""
_SLIDE_RECENT_S = 1.5 * FRAME_S
"""Duration in s of the present centre of the force: 2 samples at 50 Hz."""
_SLIDE_BEFORE_S = 0.2
"""Duration in s of the centre before it, from which a sudden motion is measured. [tuned]"""
_SLIDE_SDS = 7.0
"""Standard deviations of a slide: less than one false alarm in 1000 hours, for two coordinates and
200 samples a second, if the noise is as stated within 6 %. [statistics]"""
_SLIDE_FIRST_S = 3.5 * FRAME_S
"""Time in s of samples, at least, before a centre is compared with theirs: 4 samples at 50 Hz."""


class _Centre(NamedTuple):
    """Mean of ``n`` centres of force in m, and the variance of each of their coordinates in m²."""

    x_m: float
    y_m: float
    variance_m2: float
    n: int

    @classmethod
    def of(cls, samples: Sequence[ForceSample], *, scatter: bool = False) -> "_Centre":
        x_m, y_m = zip(*[sample.centre_m for sample in samples if sample.centre_m], strict=True)
        variance_m2 = fmean([sample.centre_noise_m**2 for sample in samples])
        if scatter and len(samples) > 1 and samples[0].frame_s is not None:
            # A unit may sum more taxels for its messages than its frames show as touched. A slide
            # hardly adds to the differences of successive messages (von Neumann 1941).
            for all_m in (x_m, y_m):
                shown_m2 = 0.5 * fmean([(b_m - a_m) ** 2 for a_m, b_m in pairwise(all_m)])
                variance_m2 = max(variance_m2, shown_m2)
        return cls(fmean(x_m), fmean(y_m), variance_m2, len(samples))

    def beyond_m(self, earlier: "_Centre", allowed_m: float) -> float:
        """Return the distance in m; 0 if it is allowed or within the noise."""
        way_m = hypot(self.x_m - earlier.x_m, self.y_m - earlier.y_m)
        variance_m2 = max(self.variance_m2, earlier.variance_m2)
        noise_m = _SLIDE_SDS * sqrt(variance_m2 * (1.0 / self.n + 1.0 / earlier.n))
        return way_m if way_m > max(allowed_m, noise_m) else 0.0


class SlipWatch:
    """Slip detector of a grip.

    It begins again at each steady set-point, after a pause, and where a push opens the fingers.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._settings = settings
        self._last_s, self._setpoint_n = -inf, 0.0

    def _begin(self, now_s: float) -> None:
        """Begin to watch another force."""
        self._since_s = now_s
        self._recent = RecentForce()
        self._usual_n = self._usual_s = 0.0
        self._was_low = False
        self._aperture_m: float | None = None
        self._first_centre: _Centre | None = None
        self._earlier: deque[ForceSample] = deque()
        self._present: deque[ForceSample] = deque()

    def check(self, moment: Moment, *, setpoint_n: float, opens: bool = False) -> None:
        """Add one period at a steady set-point; raises PartSlipped when the part slips.

        While a hot winding lowers the set-point, a force that falls is no slip.
        ``opens``: whether a push opens the fingers.
        """
        tolerance_n = self._settings.settle_tolerance_at_n(setpoint_n)
        paused = moment.now_s - self._last_s > RECOVERED_S
        if paused or opens or abs(setpoint_n - self._setpoint_n) > 0.1 * tolerance_n:
            self._setpoint_n = setpoint_n
            self._begin(moment.now_s)
        self._last_s = moment.now_s
        if (sign := self._sign(moment, setpoint_n)) is not None:
            raise PartSlipped(
                f"the held part slips: {sign}; the goals are frozen, nothing grips again by "
                f"itself: clear the fault, then release it"
            )

    def _sign(self, moment: Moment, setpoint_n: float) -> str | None:
        """Add one period at a level and return the sign of a slip as text, or None."""
        held_s, aperture_m = moment.now_s - self._since_s, moment.state.aperture_m
        slide = self._slid(held_s, moment.sample)
        if slide is not None or held_s < STEADY_S:
            return slide
        if self._aperture_m is None:
            self._aperture_m = aperture_m
        closed_m = self._aperture_m - aperture_m
        if closed_m > self._settings.slip_travel_m:
            return (
                f"the fingers have closed by {closed_m * 1e3:.2f} mm at a steady force, unless a "
                f"reported position drifts"
            )
        return self._drop(moment.sample, setpoint_n)

    def _drop(self, sample: ForceSample | None, setpoint_n: float) -> str | None:
        """Add the newest sample and return a drop of the force as text, or None."""
        settings = self._settings
        replaced = self._recent.push(sample) if sample is not None and sample.valid else None
        if replaced is None:
            return None
        self._learn([*replaced, self._recent.oldest])
        if self._usual_s < YOUNG_S:
            return None
        held_n = min(self._usual_n, setpoint_n + settings.settle_tolerance_at_n(setpoint_n))
        drop_n = held_n - self._recent.grip_n
        falls_on = self._recent.newest.grip_n < PRESENT_SHARE * self._recent.grip_n
        low = drop_n > max(settings.slip_drop_n, settings.slip_drop_share * held_n)
        # One sample may be the mean of messages before and after the removal of a part.
        was_low, self._was_low = self._was_low or len(self._recent) > 1, low
        if falls_on or not (low and was_low):
            return None
        return f"the grip force fell by {drop_n:.2f} N from {held_n:.2f} N"

    def _learn(self, samples: Sequence[ForceSample]) -> None:
        """Add all samples except the newest one to the usual force.

        Until the time constant has passed, the usual force is the mean of all.
        """
        for sample, following in pairwise(samples):
            time_s = following.t_s - sample.t_s
            self._usual_s += time_s
            share = max(1.0 - exp(-time_s / _USUAL_TIME_S), time_s / self._usual_s)
            self._usual_n += share * (sample.grip_n - self._usual_n)

    def _slid(self, held_s: float, sample: ForceSample | None) -> str | None:
        """Add the newest sample and return a slide along the pads as text, or None.

        The centre of the force moves with the part. A sudden motion only has to exceed the noise.
        A slow one, which may be creeping foam, is compared with the first centre. ``held_s``: time
        of steady force in s.
        """
        if sample is None or not sample.valid or sample.centre_m is None:
            return None
        recent, before = self._present, self._earlier
        if held_s < BRIEF_S or (recent and sample.t_s == recent[-1].t_s):
            return None
        recent.append(sample)
        while sample.t_s - recent[0].t_s > _SLIDE_RECENT_S:
            before.append(recent.popleft())
        while before and recent[0].t_s - before[0].t_s > _SLIDE_BEFORE_S:
            before.popleft()
        if self._first_centre is None:
            if not before or recent[0].t_s - before[0].t_s < _SLIDE_FIRST_S:
                return None
            self._first_centre = _Centre.of(before, scatter=True)
        now, slide_m = _Centre.of(recent), self._settings.slide_m
        # After a gap of the samples there is only the first centre.
        sudden_m = 0.0
        if before:
            earlier = _Centre.of(before, scatter=True)
            sudden_m = now.beyond_m(earlier, min(CREEP_M, slide_m))
        along_m = max(now.beyond_m(self._first_centre, slide_m), sudden_m)
        if not along_m:
            return None
        # Counts added to all taxels move the centre of the force towards the middle of the pads.
        doubt = "" if sudden_m else ", unless the zero of the pads drifts"
        return f"it has slid along the pads by {1e3 * along_m:.2f} mm{doubt}"
