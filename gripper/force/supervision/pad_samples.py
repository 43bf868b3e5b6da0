"""Newest force samples of one grip: whether its pads are loaded, empty, or suddenly empty."""

from collections import deque
from math import sqrt

from gripper.force.approach.contact import LOADED_SHARE
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.recent import LOOK_BACK_S, ONE_FRAME_S, RecentForce

_EMPTY_SHARE = 0.25
"""Share of ``contact_force_n`` below which a pad is empty. [tuned]"""
_SUDDEN_RATIO = 6.0
"""Least force, relative to an empty pad, before a sudden loss of force on the pads. [tuned]"""
HELD_SHARE = 0.5
"""Share of the earlier force above which the pads show the part; noise must not make it look like
an empty pad. [tuned]"""
_SUDDEN_SIGMAS = 3.0
"""Required certainty of the samples, in standard deviations of each pad's mean. [statistics]"""
_PAD_NOISE = sqrt(2.0)
"""Noise of one pad over that of the grip force, the mean of both. [statistics]"""


class PadSamples:
    """Newest force samples, and the force before them.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self.recent = RecentForce()
        """As many of the newest as a decision needs."""
        self.empty_n = _EMPTY_SHARE * settings.contact_force_n
        """Force in N below which a pad is empty."""
        self.loaded_n = LOADED_SHARE * settings.contact_force_n
        """Force in N above which the mean of frames shows a pad as loaded."""
        self._before_n: deque[tuple[float, float]] = deque()

    def clear(self) -> None:
        """Discard all samples."""
        self.recent.clear()
        self._before_n.clear()

    def take(self, sample: ForceSample) -> None:
        """Add a sample, which may be the same as before."""
        if self.recent.push(sample) is not None and self.recent.complete:
            self._before_n.append((sample.t_s, self.recent.grip_n))
            while sample.t_s - self._before_n[0][0] > LOOK_BACK_S:
                self._before_n.popleft()

    @property
    def loaded(self) -> bool:
        """Whether the mean of the last samples shows force on both pads."""
        return bool(self.recent) and min(self.recent.finger_means_n) > self.empty_n

    @property
    def empty(self) -> bool:
        """Whether the mean of the last samples shows no force on either pad."""
        return max(self.recent.finger_means_n) < self.empty_n

    @property
    def newest_text(self) -> str:
        """Force of the newest sample on both fingers as text."""
        return "{:.2f} and {:.2f} N".format(*self.recent.newest.force_n)

    @property
    def before_n(self) -> float:
        """Largest grip force in N of the look-back window, a mean of enough samples."""
        return max((force_n for _, force_n in self._before_n), default=0.0)

    def suddenly_empty(self, planned_n: float) -> bool:
        """Return whether almost no force is left although ``planned_n`` N were planned.

        One sample is enough if its noise cannot hide the earlier force; a fast sensor needs more.
        """
        much_n = min(planned_n, self.before_n)
        if much_n <= _SUDDEN_RATIO * self.empty_n:
            return False
        newest = self._newest(much_n)
        pad_noise_n = _PAD_NOISE * newest.noise_n
        held_n = HELD_SHARE * much_n
        noisy_n = min(self.empty_n + pad_noise_n, held_n - _SUDDEN_SIGMAS * pad_noise_n)
        return max(newest.finger_means_n) < max(self.empty_n, noisy_n)

    def loaded_again(self, force_n: float) -> bool:
        """Return whether the newest samples show half of an earlier force in N."""
        least_n = min(self._newest(force_n).finger_means_n)
        return least_n > max(self.loaded_n, HELD_SHARE * force_n)

    def _newest(self, force_n: float) -> RecentForce:
        """Return as many of the newest samples as distinguish a force from that of empty pads."""
        noise_n = (HELD_SHARE * force_n - self.empty_n) / _SUDDEN_SIGMAS / _PAD_NOISE
        newest = RecentForce(max(0.0, noise_n), least=1, longest_s=ONE_FRAME_S)
        for sample in reversed(list(self.recent)):
            newest.push(sample)
        return newest


class FrameMean:
    """Mean force of the whole frames that were scanned after a moment.

    Parameters
    ----------
    since_s
        That moment, monotonic time in s.
    """

    def __init__(self, since_s: float) -> None:
        self._newest_s = since_s
        self._forces_n: list[tuple[float, float]] = []

    def __len__(self) -> int:
        return len(self._forces_n)

    def push(self, sample: ForceSample) -> None:
        """Add the frame of a sample, which may be the same as before."""
        if sample.frame_s is not None and sample.frame_s > self._newest_s:
            self._newest_s = sample.frame_s
            self._forces_n.append(sample.frame_n)

    @property
    def finger_means_n(self) -> tuple[float, float]:
        """Mean force in N on finger 0 and finger 1; 0 without a frame."""
        n = max(1, len(self._forces_n))
        return sum(f[0] for f in self._forces_n) / n, sum(f[1] for f in self._forces_n) / n
