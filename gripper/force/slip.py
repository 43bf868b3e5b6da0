"""Detection of a held part that slips: by its force, the way of the fingers, or its place."""

from collections import deque
from collections.abc import Collection
from math import exp, hypot

from gripper.errors import PartSlipped
from gripper.force.loop import Moment
from gripper.settings import GripperSettings
from gripper.state import ForceSample

# Figures are tuned in the simulated cell: no alarm with noise of 0.3 N, an alarm within 0.1 s.
_SETTLING_S = 0.3
"""Time in s after the start of a hold from which on force and opening are compared."""
_USUAL_TIME_S = 0.6
"""Time constant in s of the usual force, that a drop is measured from."""
_RECENT_SAMPLES = 4
"""Samples whose mean is the force now: 80 ms at 50 Hz."""
_SLIDE_SETTLING_S = 0.1
"""Time in s after the start of a hold from which on the centre of the force is compared."""
_SLIDE_FIRST = 4
"""Samples whose mean is the first centre of the force."""
_SLIDE_RECENT = 2
"""Samples whose mean is the centre of the force now."""
_SLIDE_FORCE_N = 4.0
"""Force in N from which on a centre is as exact as ``slide_m`` assumes."""
_LEAST_FORCE_N = 0.1
"""Force in N that a weaker one counts as, so that the allowed way stays finite."""


class SlipWatch:
    """Slip detector of one hold at a steady set-point.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._settings = settings
        self._recent: deque[ForceSample] = deque(maxlen=_RECENT_SAMPLES)
        self._usual_n: float | None = None
        self._aperture_m: float | None = None
        self._since_s: float | None = None
        self._slide = SlideWatch(settings)

    def check(
        self, now_s: float, aperture_m: float, sample: ForceSample | None, *, setpoint_n: float
    ) -> str | None:
        """Add one period and return what shows a slip, None without one.

        Parameters
        ----------
        now_s
            Monotonic time in s.
        aperture_m
            Opening in m.
        sample
            Newest sample, which may be the same as before.
        setpoint_n
            Force that is asked for in N: what is more than that, as after a stall in the ramp, is
            given back by the force loop and slips nowhere.
        """
        if self._since_s is None:
            self._since_s = now_s
        slide = self._slide.check(now_s - self._since_s, sample)
        if slide is not None or now_s - self._since_s < _SETTLING_S:
            return slide
        if self._aperture_m is None:
            self._aperture_m = aperture_m
        settings = self._settings
        closed_m = self._aperture_m - aperture_m
        if closed_m > settings.slip_travel_m:
            return (
                f"the fingers have closed by {closed_m * 1e3:.2f} mm at a steady force, unless a "
                f"reported position drifts"
            )
        last_s = self._recent[-1].t_s if self._recent else None
        if sample is None or not sample.valid or sample.t_s == last_s:
            return None
        if len(self._recent) == _RECENT_SAMPLES:
            oldest = self._recent[0]
            share = 1.0 - exp(-(self._recent[1].t_s - oldest.t_s) / _USUAL_TIME_S)
            usual_n = oldest.grip_n if self._usual_n is None else self._usual_n
            self._usual_n = usual_n + share * (oldest.grip_n - usual_n)
        self._recent.append(sample)
        if self._usual_n is None:
            return None
        held_n = min(self._usual_n, setpoint_n + settings.settle_tolerance_at_n(setpoint_n))
        drop_n = held_n - sum(s.grip_n for s in self._recent) / len(self._recent)
        if drop_n > max(settings.slip_drop_n, settings.slip_drop_share * held_n):
            return f"the grip force fell by {drop_n:.2f} N from {held_n:.2f} N"
        return None


class SlideWatch:
    """Detector of a part that slides along the pads: the centre of its force moves with it.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._settings = settings
        self._first: list[tuple[float, ...]] = []
        self._recent: deque[tuple[float, ...]] = deque(maxlen=_SLIDE_RECENT)
        self._last_s: float | None = None

    def check(self, held_s: float, sample: ForceSample | None) -> str | None:
        """Add the newest sample and return what shows a slide, None without one.

        Parameters
        ----------
        held_s
            For how long the force has been steady, in s.
        sample
            Newest sample, which may be the same as before.
        """
        if sample is None or not sample.valid or sample.centre_m is None:
            return None
        if held_s < _SLIDE_SETTLING_S or sample.t_s == self._last_s:
            return None
        self._last_s = sample.t_s
        place = (*sample.centre_m[0], *sample.centre_m[1])
        if len(self._first) < _SLIDE_FIRST:
            self._first.append(place)
            return None
        self._recent.append(place)
        if len(self._recent) < _SLIDE_RECENT:
            return None
        usual, now = _mean(self._first), _mean(self._recent)
        # Both pads must agree: what one pad alone sees is its noise, or the part tilts.
        along_m = [hypot(now[i] - usual[i], now[i + 1] - usual[i + 1]) for i in (0, 2)]
        # The weaker the force, the less its centre is worth.
        allowed_m = self._settings.slide_m * max(
            1.0, _SLIDE_FORCE_N / max(sample.grip_n, _LEAST_FORCE_N)
        )
        if min(along_m) <= allowed_m:
            return None
        return f"it has slid along the pads by {1e3 * min(along_m):.2f} mm"


def _mean(places: Collection[tuple[float, ...]]) -> list[float]:
    return [sum(values) / len(places) for values in zip(*places, strict=True)]


class LevelSlip:
    """Slip detector of all levels at which the force is held: a `SlipWatch` for each.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._settings = settings
        self._level: int | None = None
        self._watch = SlipWatch(settings)

    def check(self, moment: Moment, level: int | None, *, setpoint_n: float) -> None:
        """Add one period at a level, or on the way to the next; PartSlipped when the part slips."""
        if level != self._level:
            self._level, self._watch = level, SlipWatch(self._settings)
        if level is None:
            return
        sign = self._watch.check(
            moment.now_s, moment.state.aperture_m, moment.sample, setpoint_n=setpoint_n
        )
        if sign is not None:
            raise PartSlipped(
                f"the held part slips: {sign}; the goals are frozen, nothing grips again by "
                f"itself: release it, or clear the fault and go on"
            )
