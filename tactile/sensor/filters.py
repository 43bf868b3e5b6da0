"""Filters over taxels and over time, and detection of touched taxels. Pure.

All of them take and return one value for each taxel in counts, shape (n_taxels,).
"""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile.layout import TaxelLayout

Values = NDArray[np.float64]
"""One value for each taxel, (n_taxels,)."""
_OFFSETS = tuple((row, column) for row in (-1, 0, 1) for column in (-1, 0, 1))
"""Steps in rows and columns to the 3 x 3 neighbours, row by row."""
_BINOMIAL = {0: 4.0, 1: 2.0, 2: 1.0}
"""Weights of the 3 x 3 binomial kernel by distance in steps; sum 16."""


class Neighbourhood:
    """The 3 x 3 neighbours of each taxel on its own pad."""

    def __init__(self, layout: TaxelLayout) -> None:
        self.layout = layout
        n = layout.n_taxels
        self.index = index = np.full((n, len(_OFFSETS)), n, dtype=np.int64)
        """(n_taxels, 9) int64: neighbours row by row, the taxel itself in the middle; n_taxels
        beyond the border."""
        self.weight = weight = np.zeros((n, len(_OFFSETS)))
        """(n_taxels, 9) float64: binomial weights, 0 beyond the border."""
        for pad_index, pad in enumerate(layout.pads):
            first = layout.taxels_of(pad_index).start
            row, column = np.divmod(np.arange(pad.n_taxels), pad.columns)
            for place, (row_step, column_step) in enumerate(_OFFSETS):
                r, c = row + row_step, column + column_step
                inside = (r >= 0) & (r < pad.rows) & (c >= 0) & (c < pad.columns)
                taxels = first + np.flatnonzero(inside)
                index[taxels, place] = first + (r * pad.columns + c)[inside]
                weight[taxels, place] = _BINOMIAL[abs(row_step) + abs(column_step)]
        index.setflags(write=False)
        weight.setflags(write=False)
        self.total: Values = weight.sum(axis=1)
        """(n_taxels,) float64: sum of the weights of each taxel."""

    def gather(self, values: NDArray[Any], outside: float) -> NDArray[Any]:
        """Return each taxel's neighbours' values, ``outside`` beyond the border, (n_taxels, 9)."""
        extended = np.empty(len(values) + 1, dtype=values.dtype)
        extended[:-1] = values
        extended[-1] = outside
        return extended[self.index]


def spatial_mean(hood: Neighbourhood, values: Values) -> Values:
    """Return the binomial mean over 3 x 3 taxels (a Gaussian of 0.7 taxels).

    At a border the remaining weights are scaled up, so that a constant stays constant.
    """
    result: Values = np.einsum("ij,ij->i", hood.gather(values, 0.0), hood.weight)
    result /= hood.total
    return result


def fill_bad(hood: Neighbourhood, values: Values, bad: NDArray[np.bool_]) -> Values:
    """Replace bad taxels by the weighted mean of their good neighbours; 0 without good ones."""
    if not bad.any():
        return values
    weight = hood.weight[bad] * hood.gather(~bad, outside=0.0)[bad]
    total = weight.sum(axis=1)
    filled = values.copy()
    weighted = (hood.gather(values, 0.0)[bad] * weight).sum(axis=1)
    filled[bad] = np.divide(weighted, total, out=np.zeros(len(total)), where=total > 0.0)
    return filled


def dilate(hood: Neighbourhood, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask grown by one taxel in all eight directions."""
    neighbours: NDArray[np.bool_] = hood.gather(mask, outside=0.0)
    grown: NDArray[np.bool_] = np.any(neighbours, axis=1)
    return grown


def regions_from(
    hood: Neighbourhood, seed: NDArray[np.bool_], allowed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return all allowed taxels with a connection to a seed through allowed ones."""
    region: NDArray[np.bool_] = seed & allowed
    while True:
        grown: NDArray[np.bool_] = dilate(hood, region) & allowed
        if np.array_equal(grown, region):
            return region
        region = grown


class MovingMean:
    """Mean over the last n frames: settles completely after n frames.

    Parameters
    ----------
    n_frames
        Length of the window, at least 1.
    """

    def __init__(self, n_frames: int) -> None:
        if n_frames < 1:
            raise ValueError(f"a window of {n_frames} frames, must be at least 1")
        self._frames: deque[Values] = deque(maxlen=n_frames)

    def reset(self) -> None:
        """Discard all frames."""
        self._frames.clear()

    @property
    def full(self) -> bool:
        """Whether the window is full."""
        return len(self._frames) == self._frames.maxlen

    def step(self, values: Values) -> Values:
        """Take a frame and return the mean over the window."""
        self._frames.append(values)
        # With an array for each frame, summing is faster than np.mean over the queue.
        total: Values = sum(self._frames, np.zeros_like(values))
        return total / len(self._frames)


@dataclass(frozen=True, slots=True, kw_only=True)
class TouchThresholds:
    """Thresholds of touched taxels, in standard deviations of their smoothed noise."""

    start: float = 5.5
    """A region starts at a taxel above this."""
    keep: float = 3.0
    """A region lasts while at least one of its taxels is above this."""
    join: float = 4.0
    """A taxel next to a region joins it above this."""
    leave: float = 0.0
    """A taxel leaves its region below this."""

    def __post_init__(self) -> None:
        if not (self.leave <= self.join <= self.start and 0.0 < self.keep <= self.start):
            raise ValueError(
                f"touch thresholds start {self.start}, keep {self.keep}, join {self.join}, leave "
                f"{self.leave}: must be leave <= join <= start and 0 < keep <= start"
            )


def smoothing_gain(hood: Neighbourhood, passes: int) -> Values:
    """Return the factor of ``passes`` of `spatial_mean` on independent noise, (n_taxels,)."""
    n = hood.layout.n_taxels
    kernel = np.zeros((n, n + 1))
    np.add.at(kernel, (np.arange(n)[:, None], hood.index), hood.weight)
    step = kernel[:, :n] / hood.total[:, None]
    gain: Values = np.linalg.norm(np.linalg.matrix_power(step, passes), axis=1)
    return gain


def typical_noise(layout: TaxelLayout, noise_counts: Values, least_counts: float) -> Values:
    """Return the typical noise of its pad for each taxel, (n_taxels,), at least a limit.

    A hundred frames are too few for the noise of a single taxel.
    """
    noise = np.full(layout.n_taxels, least_counts)
    for pad in range(layout.n_pads):
        taxels = layout.taxels_of(pad)
        noise[taxels] = np.maximum(noise[taxels], np.median(noise_counts[taxels]))
    return noise


class ActiveTaxels:
    """Connected regions above the noise, at two scales: 3 x 3 and 5 x 5 taxels.

    The small scale is for a pointed object, the large one for a flat object that presses every
    taxel lightly. Regions and single taxels have hysteresis. Without it a border taxel would be
    summed only while its noise is positive, which would bias the force.

    Parameters
    ----------
    thresholds
        In standard deviations.
    noise_counts : (n_taxels,) float64
        Standard deviation of the counts of `step`, above 0.
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
