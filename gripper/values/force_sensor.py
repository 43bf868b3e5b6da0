"""Force on the fingers: a sample, the interface of its sensor, the newest samples."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import sqrt
from typing import Protocol


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceSample:
    """Normal force on both fingers, tared and calibrated."""

    t_s: float
    """Monotonic time of the measurement in s."""
    force_n: tuple[float, float]
    """Normal force on finger 0 and on finger 1 in N."""
    valid: bool = True
    """False when the value must not be used for control (saturated pad, too many bad taxels)."""
    at_least: bool = False
    """True if it is not valid because taxels are at full scale: the force is at least this one."""
    reason: str = ""
    """Why it is not valid, or empty."""
    centre_m: tuple[float, float] | None = None
    """Centre of the grip force in the grip frame in m, along the fingers and across them: the mean
    of both pads' centres; None if not known, or without a touch."""
    centre_noise_m: float = 0.0
    """Standard deviation of each coordinate of ``centre_m``, as ``noise_n`` is of the force."""
    lag_s: float = 0.02
    """Mean age of the force at ``t_s`` in s: filters, transmission."""
    noise_n: float = 0.3
    """Standard deviation of `grip_n` in N, in addition to that of the samples before it."""
    frame_s: float | None = None
    """Monotonic time in s of the scan of the newest whole frame, a second measurement; None if the
    samples come from frames."""
    frame_n: tuple[float, float] = (0.0, 0.0)
    """Normal force on finger 0 and on finger 1 in N in that frame alone."""

    @property
    def measured_s(self) -> float:
        """Monotonic time in s to which the force belongs."""
        return self.t_s - self.lag_s

    @property
    def grip_n(self) -> float:
        """Grip force in N: the mean of both fingers, which are equal in equilibrium."""
        return 0.5 * (self.force_n[0] + self.force_n[1])


class ForceSensor(Protocol):
    """Source of force samples; called once every period of the force loop, must not block."""

    def latest_force(self) -> ForceSample | None:
        """Return the newest sample, None while there is none; the caller judges its age."""


FRAME_S = 0.02
"""Period in s of whole frames, the slowest supported samples: 50 Hz. [chosen]"""
ONE_FRAME_S = 0.018
"""Time in s in which faster samples count as one frame: just below its period. [chosen]"""
LOOK_BACK_S = 4.5 * FRAME_S
"""Time in s of a look back: five frames."""
QUIET_N = 0.08
"""Noise in N of the mean grip force for control and caps: a fraction of the tolerance of a ramp's
end. [tuned]"""
LEAST_SAMPLES = 3
"""Samples of this mean for a slower sensor. [chosen]"""


def mean_n(forces_n: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Return the mean force in N on finger 0 and finger 1; 0 without any."""
    n = max(1, len(forces_n))
    return sum([one_n for one_n, _ in forces_n]) / n, sum([two_n for _, two_n in forces_n]) / n


class RecentForce:
    """Newest force samples, enough for a noise of their mean below a limit.

    A fast sensor gives many in a short time. A slow sensor gives its last few.

    Parameters
    ----------
    noise_n
        Standard deviation in N of the mean grip force that is low enough.
    one_frame
        True to keep the samples of one frame only: one of a slow sensor. Else those of the last
        three frames are kept, with half a frame to spare; of a slow sensor three.
    """

    def __init__(self, noise_n: float = QUIET_N, *, one_frame: bool = False) -> None:
        self._noise_n = noise_n
        self._least = 1 if one_frame else LEAST_SAMPLES
        self._longest_s = ONE_FRAME_S if one_frame else (LEAST_SAMPLES - 0.5) * FRAME_S
        self._samples: deque[ForceSample] = deque()

    def __len__(self) -> int:
        return len(self._samples)

    def __iter__(self) -> Iterator[ForceSample]:
        """Iterate over the samples, the newest one first."""
        return reversed(self._samples)

    @property
    def newest(self) -> ForceSample:
        """The newest sample."""
        return self._samples[-1]

    @property
    def oldest(self) -> ForceSample:
        """The oldest sample."""
        return self._samples[0]

    @property
    def finger_means_n(self) -> tuple[float, float]:
        """Mean force in N on finger 0 and finger 1."""
        return mean_n([sample.force_n for sample in self._samples])

    @property
    def grip_n(self) -> float:
        """Mean grip force in N."""
        both_n = 0.0
        for sample in self._samples:
            both_n += sample.force_n[0] + sample.force_n[1]
        return 0.5 * both_n / len(self._samples)

    @property
    def noise_n(self) -> float:
        """Standard deviation of the mean grip force in N."""
        return sqrt(sum([sample.noise_n**2 for sample in self._samples])) / len(self._samples)

    @property
    def complete(self) -> bool:
        """Whether the noise of the mean is low enough, or the samples are the least number."""
        return len(self._samples) >= self._least or self.noise_n <= self._noise_n

    def clear(self) -> None:
        """Discard all samples."""
        self._samples.clear()

    def push(self, sample: ForceSample) -> list[ForceSample] | None:
        """Add a sample and return those that it replaces; None for one that is not newer."""
        samples = self._samples
        if samples and sample.t_s <= samples[-1].t_s:
            return None
        samples.append(sample)
        variance_n2 = 0.0
        for summed in samples:
            variance_n2 += summed.noise_n**2
        replaced: list[ForceSample] = []
        for left in range(len(samples) - 1, 0, -1):
            variance_n2 -= samples[0].noise_n ** 2
            enough = variance_n2 <= (self._noise_n * left) ** 2
            old = sample.t_s - samples[0].t_s > self._longest_s and left >= self._least
            if not enough and not old:
                break
            replaced.append(samples.popleft())
        return replaced
