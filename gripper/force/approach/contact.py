"""Contact by the pads: the first touch, the sure contact, and its force at rest."""

from collections import deque
from math import sqrt

from gripper.force.loop import Moment
from gripper.values.force_sensor import ForceSample
from gripper.values.recent import ONE_FRAME_S, QUIET_N, RecentForce

LOADED_SHARE = 0.5
"""Share of ``contact_force_n`` above which the mean of some samples shows a pad as loaded: several
times its noise. [tuned]"""
_TOUCH_N = 0.12
"""Least force in N on a pad that shows a first touch, also on a quiet pad. [tuned]"""
_TOUCH_SIGMAS = 3.5
"""Standard deviations of the empty pad's noise by which a first touch exceeds it. [statistics]"""
_EMPTY_SAMPLES = 20
"""Number of samples for the noise of an empty pad. [tuned]"""
_TOUCH_SAMPLES = 8
"""Most newest samples whose mean is compared with it; older ones are of the empty pad. [tuned]"""
_REST_S, _HARD_S, _REST_SETTLING_S = 0.08, 0.065, 0.01
"""Rest of the fingers at the contact, so that the ramp begins at the force there. Its longest time
in s, its least after a hard touch, and the time before its samples count. [tuned]"""


class FirstTouch:
    """Detector of the first force on a pad above the noise of the empty pad.

    It may be wrong sometimes: the approach then continues.
    """

    def __init__(self) -> None:
        self._empty_n2: list[float] = []
        self._recent: deque[ForceSample] = deque(maxlen=_TOUCH_SAMPLES)

    @property
    def shows(self) -> tuple[bool, bool]:
        """Whether the newest samples show a touch of finger 0 and of finger 1."""
        return self._stands_out(0), self._stands_out(1)

    @property
    def lasts(self) -> tuple[bool, bool]:
        """Whether the mean of the last samples still shows a touch of finger 0 and of finger 1."""
        first_n, second_n = self.means_n(max(1, len(self._recent)))
        return first_n > _TOUCH_N, second_n > _TOUCH_N

    def means_n(self, samples: int) -> tuple[float, float]:
        """Return the mean force in N on finger 0 and finger 1 in so many of the newest samples.

        0 where there are fewer.
        """
        newest = list(self._recent)[-min(samples, _TOUCH_SAMPLES) :]
        if len(newest) < min(samples, _TOUCH_SAMPLES):
            return 0.0, 0.0
        n = len(newest)
        return sum(s.force_n[0] for s in newest) / n, sum(s.force_n[1] for s in newest) / n

    def push(self, sample: ForceSample, *, empty: bool) -> None:
        """Add a sample, which may be the same as before; ``empty``: no finger is braked."""
        if self._recent and sample.t_s <= self._recent[-1].t_s:
            return
        if not self._empty_n2:
            self._empty_n2 = [2.0 * sample.noise_n**2] * 2
        elif empty and len(self._recent) == _TOUCH_SAMPLES:
            for finger, force_n in enumerate(self._recent[0].force_n):
                self._empty_n2[finger] += (force_n**2 - self._empty_n2[finger]) / _EMPTY_SAMPLES
        self._recent.append(sample)

    def _stands_out(self, finger: int) -> bool:
        sum_n = 0.0
        for n, sample in enumerate(reversed(self._recent), 1):
            sum_n += sample.force_n[finger]
            noise_n = sqrt(self._empty_n2[finger] / n)
            if sum_n > n * max(_TOUCH_N, _TOUCH_SIGMAS * noise_n):
                return True
        return False


class ContactDetector:
    """Detector of a contact: enough new samples in a row above a threshold, for each finger.

    With a fast sensor the mean of a sample and those shortly before it counts, to reduce the noise.

    Parameters
    ----------
    threshold_n
        Force on a pad in N that counts.
    samples
        New samples in a row that confirm.
    """

    def __init__(self, threshold_n: float, samples: int) -> None:
        self._threshold_n = threshold_n
        self._samples = samples
        self._counts = [0, 0]
        self._first_s = [0.0, 0.0]
        self._recent = RecentForce(least=1, longest_s=ONE_FRAME_S)

    @property
    def touched(self) -> tuple[bool, bool]:
        """Contact of finger 0 and finger 1."""
        return self._counts[0] >= self._samples, self._counts[1] >= self._samples

    @property
    def first_s(self) -> float:
        """Time in s at which the finger that touched last was loaded."""
        return max(self._first_s)

    def push(self, sample: ForceSample) -> None:
        """Add a sample, which may be the same as before."""
        if self._recent.push(sample) is None:
            return
        for finger, force_n in enumerate(self._recent.finger_means_n):
            above = force_n >= self._threshold_n
            if self._counts[finger] == 0:
                self._first_s[finger] = self._recent.oldest.measured_s
            self._counts[finger] = self._counts[finger] + 1 if above else 0


class ContactRest:
    """Rest of the fingers on the part, until the pads have measured its force.

    Parameters
    ----------
    begun_s
        Monotonic time in s of the contact.
    hard_n
        Least force in N of a hard touch.
    """

    def __init__(self, begun_s: float, *, hard_n: float) -> None:
        self._begun_s, self._hard_n = begun_s, hard_n
        self._samples = RecentForce()

    @property
    def force_n(self) -> float:
        """Mean grip force in N of the last samples, at least 0; 0 without any."""
        return max(0.0, self._samples.grip_n) if self._samples else 0.0

    def goes_on(self, moment: Moment) -> bool:
        """Add the newest sample and return whether the fingers still rest."""
        sample, settled_s = moment.sample, self._begun_s + _REST_SETTLING_S
        if sample is not None and sample.valid:
            if self._samples and self._samples.oldest.measured_s < settled_s <= sample.measured_s:
                self._samples.clear()
            self._samples.push(sample)
        known = (
            self._samples
            and self._samples.oldest.measured_s >= settled_s
            and self._samples.noise_n <= QUIET_N
        )
        rested_s = moment.now_s - self._begun_s
        fresh = self.force_n >= self._hard_n and rested_s < _HARD_S
        return rested_s < _REST_S and (fresh or not known)
