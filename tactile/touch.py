"""Which taxels are touched, judged against the sensor's own noise."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile.filters import Neighbourhood, Values, regions_from, spatial_mean


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchThresholds:
    """When a taxel counts as touched, in standard deviations of its smoothed noise.

    Attributes
    ----------
    start
        A region starts where this is exceeded.
    keep
        A region lasts while this is exceeded somewhere in it.
    join
        A taxel next to a region joins it above this.
    leave
        A taxel leaves its region below this.
    """

    start: float = 5.5
    keep: float = 3.0
    join: float = 4.0
    leave: float = 0.0

    def __post_init__(self) -> None:
        if not (self.leave <= self.join <= self.start and 0.0 < self.keep <= self.start):
            raise ValueError(
                f"touch thresholds start {self.start}, keep {self.keep}, join {self.join}, leave "
                f"{self.leave}: must be leave <= join <= start and 0 < keep <= start"
            )


def smoothing_gain(hood: Neighbourhood, passes: int) -> Values:
    """Return how far ``passes`` of `spatial_mean` shrink independent noise, (n_taxels,)."""
    n = hood.layout.n_taxels
    kernel = np.zeros((n, n + 1))
    np.add.at(kernel, (np.arange(n)[:, None], hood.index), hood.weight)
    step = kernel[:, :n] / hood.weight.sum(axis=1)[:, None]
    gain: Values = np.linalg.norm(np.linalg.matrix_power(step, passes), axis=1)
    return gain


class ActiveTaxels:
    """Connected regions that stand out of the noise, at two scales: 3 x 3 and 5 x 5 taxels.

    The small scale sees a pointed object, the large one a flat object that presses every taxel
    lightly. Both the regions and their single taxels have hysteresis: a border taxel that comes
    and goes with its own noise would be summed just when its noise is positive, and bias the force.

    Parameters
    ----------
    hood
        Neighbours of the taxels.
    thresholds
        In standard deviations.
    noise_counts : (n_taxels,) float64
        Standard deviation of the counts that `step` gets, above 0.
    """

    def __init__(
        self, hood: Neighbourhood, thresholds: TouchThresholds, noise_counts: Values
    ) -> None:
        if not np.all(noise_counts > 0.0):
            raise ValueError("the noise of each taxel must be above 0 counts")
        self._hood = hood
        self._thresholds = thresholds
        self._per_small = 1.0 / (noise_counts * smoothing_gain(hood, 1))
        self._per_large = 1.0 / (noise_counts * smoothing_gain(hood, 2))
        self._active = np.zeros(hood.layout.n_taxels, dtype=np.bool_)

    def step(self, counts: Values) -> NDArray[np.bool_]:
        """Take tared counts smoothed in time and return the active taxels, (n_taxels,) bool."""
        small = spatial_mean(self._hood, counts)
        large = spatial_mean(self._hood, small) * self._per_large
        small *= self._per_small
        highest = np.maximum(small, large)
        limits = self._thresholds
        allowed = (small > limits.join) | (self._active & (small > limits.leave))
        seed = (highest > limits.start) | (self._active & (highest > limits.keep))
        self._active = regions_from(self._hood, seed, allowed)
        return self._active.copy()
