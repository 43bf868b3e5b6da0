"""Noise of the converter, new for each taxel and each frame."""

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError

NoiseKind = Literal["clipped_normal", "symmetric", "uniform", "none"]

_SIGMA_COUNTS = 10.0
_LIMIT_COUNTS = 20.0
_FULL_SCALE_COUNTS = 255.0
_LEVEL_MAX = 4.0


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """What is added to the counts of each taxel.

    The paper adds "values from a normal distribution in the range [1, 20]" to counts of 8 bit. A
    normal variable has no such range, so there are readings to choose from; all are scaled with
    the converter's full scale.

    Attributes
    ----------
    kind
        ``clipped_normal``: the magnitude of N(0, 10) clipped to [1, 20], never negative.
        ``symmetric``: N(0, 10) clipped to [-20, 20]. ``uniform``: even over [1, 20].
        ``none``: nothing.
    level
        Factor from 0 to 4 on all of it; 1 is the paper's upper limit, 8 % of full scale.
    """

    kind: NoiseKind = "clipped_normal"
    level: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(NoiseKind):
            raise SimulatorSettingsError(
                f"noise kind is {self.kind!r}, must be one of {get_args(NoiseKind)}"
            )
        if not (math.isfinite(self.level) and 0.0 <= self.level <= _LEVEL_MAX):
            raise SimulatorSettingsError(
                f"noise level is {self.level}, must be from 0 to {_LEVEL_MAX:g}"
            )

    def sample(self, rng: np.random.Generator, n: int, adc_max: int) -> NDArray[np.float64]:
        """Return noise in counts for ``n`` taxels of a converter with full scale ``adc_max``."""
        if self.kind == "none" or self.level == 0.0:
            return np.zeros(n)
        if self.kind == "uniform":
            counts = rng.uniform(1.0, _LIMIT_COUNTS, n)
        else:
            counts = _SIGMA_COUNTS * rng.standard_normal(n)
            if self.kind == "clipped_normal":
                counts = np.clip(np.abs(counts), 1.0, _LIMIT_COUNTS)
            else:
                counts = np.clip(counts, -_LIMIT_COUNTS, _LIMIT_COUNTS)
        noise: NDArray[np.float64] = counts * (self.level * adc_max / _FULL_SCALE_COUNTS)
        return noise
