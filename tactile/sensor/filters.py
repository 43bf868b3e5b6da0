"""Filters over taxels and over time, and detection of touched taxels. Pure.

All of them take and return one value for each taxel in counts, shape (n_taxels,).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from tactile.layout import TaxelLayout

Values = NDArray[np.float64]
Mask = NDArray[np.bool_]
"""One value for each taxel, (n_taxels,)."""
_START, _KEEP = 5.5, 3.0
"""A region starts at a taxel above the first, and lasts while one is above the second. All limits
are in standard deviations of the smoothed noise."""
_JOIN, _LEAVE = 4.0, 0.0
"""A taxel next to a region joins it above the first, and leaves it below the second."""


def _weights(n: int) -> Any:
    """Return the matrix (n, n) that adds the neighbours of a line of taxels by weights 1, 2, 1."""
    return sparse.diags_array([1.0, 2.0, 1.0], offsets=[-1, 0, 1], shape=(n, n))


class Neighbourhood:
    """The 3 x 3 neighbours of each taxel on its own pad, as a sparse matrix."""

    def __init__(self, layout: TaxelLayout) -> None:
        self.layout = layout
        pads = [
            sparse.kron(_weights(height), _weights(width)) for height, width in layout.pad_shape
        ]
        self._weights = sparse.block_diag(pads, format="csr")
        self._total = self.weighted(np.ones(layout.n_taxels))
        self._others = (self._weights - sparse.diags_array(self._weights.diagonal())) > 0.0

    def weighted(self, values: Values) -> Values:
        """Return the sum of the neighbours' values (..., n_taxels) by weights of 1, 2 and 4."""
        total: Values = (self._weights @ values.T).T
        return total

    def mean(self, values: Values) -> Values:
        """Return the binomial mean over 3 x 3 taxels (a Gaussian of 0.7 taxels).

        At a border the remaining weights are scaled up, so that a constant stays constant.
        """
        return self.weighted(values) / self._total

    def with_neighbours(self, mask: Mask) -> Mask:
        """Return the taxels of a mask (n_taxels,) and their neighbours."""
        return self.weighted(mask.astype(np.float64)) > 0.0

    def highest_neighbour(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the highest value of each taxel's up to eight neighbours, which are at least 0."""
        highest: NDArray[Any] = self._others.multiply(values).max(axis=1).toarray().ravel()
        return highest

    def connected(self, seed: Mask, allowed: Mask) -> Mask:
        """Return all allowed taxels with a connection to a seed through allowed ones."""
        region, grown = np.zeros_like(seed), seed & allowed
        while not np.array_equal(region, grown):
            region, grown = grown, self.with_neighbours(grown) & allowed
        return grown


def fill_bad(hood: Neighbourhood, values: Values, bad: Mask) -> Values:
    """Replace bad taxels by the weighted mean of their good neighbours; 0 without good ones."""
    if not bad.any():
        return values
    total = hood.weighted((~bad).astype(np.float64))[bad]
    filled = values.copy()
    weighted = hood.weighted(np.where(bad, 0.0, values))[bad]
    filled[bad] = np.divide(weighted, total, out=np.zeros(len(total)), where=total > 0.0)
    return filled


def smoothing_gain(hood: Neighbourhood, passes: int) -> Values:
    """Return the factor of ``passes`` of the mean on independent noise, (n_taxels,)."""
    answers = np.eye(hood.layout.n_taxels)
    for _ in range(passes):
        answers = hood.mean(answers)
    return np.asarray(np.linalg.norm(answers, axis=0), dtype=np.float64)


def typical_noise(layout: TaxelLayout, noise_counts: Values, least_counts: float) -> Values:
    """Return the typical noise of its pad for each taxel, (n_taxels,), at least a limit.

    A hundred frames are too few for the noise of a single taxel.
    """
    noise: Values = np.maximum(layout.medians(noise_counts), least_counts)[layout.taxel_pad]
    return noise


class ActiveTaxels:
    """Connected regions above the noise, at two scales: 3 x 3 and 5 x 5 taxels.

    The small scale is for a pointed object, the large one for a flat object that presses every
    taxel lightly. Regions and single taxels have hysteresis. Without it a border taxel would be
    summed only while its noise is positive, which would bias the force.

    Parameters
    ----------
    noise_counts : (n_taxels,) float64
        Standard deviation of the counts of `step`, above 0.
    """

    def __init__(self, hood: Neighbourhood, noise_counts: Values) -> None:
        if not np.all(noise_counts > 0.0):
            raise ValueError("the noise of each taxel must be above 0 counts")
        self._hood = hood
        self._per_small = 1.0 / (noise_counts * smoothing_gain(hood, 1))
        self._per_large = 1.0 / (noise_counts * smoothing_gain(hood, 2))
        self._active = np.zeros(hood.layout.n_taxels, dtype=np.bool_)

    def step(self, counts: Values) -> Mask:
        """Take tared counts smoothed in time and return the active taxels, (n_taxels,) bool."""
        small = self._hood.mean(counts)
        large = self._hood.mean(small) * self._per_large
        small *= self._per_small
        highest = np.maximum(small, large)
        allowed = (small > _JOIN) | (self._active & (small > _LEAVE))
        seed = (highest > _START) | (self._active & (highest > _KEEP))
        self._active = self._hood.connected(seed, allowed)
        return self._active.copy()
