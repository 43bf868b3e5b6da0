"""Noise filters over taxels and over time; they run before any surface is fitted.

All of them take and return one value a taxel, shape (n_taxels,), and know nothing of forces.
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile.layout import TaxelLayout

Values = NDArray[np.float64]
_OFFSETS = tuple((row, column) for row in (-1, 0, 1) for column in (-1, 0, 1))
_BINOMIAL = {0: 4.0, 1: 2.0, 2: 1.0}
"""Weights of the 3 x 3 binomial kernel by distance in steps; sum 16."""


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """The 3 x 3 neighbours of each taxel on its own pad; nothing reaches across a pad's border.

    Attributes
    ----------
    layout
        The pads.
    index : (n_taxels, 9) int64
        Neighbours row by row, the taxel itself in the middle; n_taxels where the pad ends.
    weight : (n_taxels, 9) float64
        Binomial weights, 0 beyond the border.
    """

    layout: TaxelLayout
    index: NDArray[np.int64] = field(init=False)
    weight: Values = field(init=False)

    def __post_init__(self) -> None:
        n = self.layout.n_taxels
        index = np.full((n, len(_OFFSETS)), n, dtype=np.int64)
        weight = np.zeros((n, len(_OFFSETS)))
        for pad_index, pad in enumerate(self.layout.pads):
            first = self.layout.taxels_of(pad_index).start
            row, column = np.divmod(np.arange(pad.n_taxels), pad.columns)
            for place, (row_step, column_step) in enumerate(_OFFSETS):
                r, c = row + row_step, column + column_step
                inside = (r >= 0) & (r < pad.rows) & (c >= 0) & (c < pad.columns)
                taxels = first + np.flatnonzero(inside)
                index[taxels, place] = first + (r * pad.columns + c)[inside]
                weight[taxels, place] = _BINOMIAL[abs(row_step) + abs(column_step)]
        index.setflags(write=False)
        weight.setflags(write=False)
        object.__setattr__(self, "index", index)
        object.__setattr__(self, "weight", weight)

    def gather(self, values: NDArray[Any], outside: float) -> NDArray[Any]:
        """Return each taxel's neighbours' values, ``outside`` beyond the border, (n_taxels, 9)."""
        extended = np.empty(len(values) + 1, dtype=values.dtype)
        extended[:-1] = values
        extended[-1] = outside
        neighbours: NDArray[Any] = extended[self.index]
        return neighbours


def spatial_mean(hood: Neighbourhood, values: Values) -> Values:
    """Return the binomial mean over 3 x 3 taxels (a Gaussian of 0.7 taxels).

    At a border the weights that remain are scaled up, so a constant stays the same constant.
    """
    result: Values = np.einsum("ij,ij->i", hood.gather(values, 0.0), hood.weight)
    result /= hood.weight.sum(axis=1)
    return result


def spatial_median(hood: Neighbourhood, values: Values) -> Values:
    """Return the median over those of the 3 x 3 taxels that are on the pad."""
    result: Values = np.nanmedian(hood.gather(values, np.nan), axis=1)
    return result


def fill_bad(hood: Neighbourhood, values: Values, bad: NDArray[np.bool_]) -> Values:
    """Replace bad taxels by the weighted mean of their good neighbours; 0 where none is good."""
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
    """Return all allowed taxels that are connected to a seed through allowed ones."""
    region: NDArray[np.bool_] = seed & allowed
    while True:
        grown: NDArray[np.bool_] = dilate(hood, region) & allowed
        if np.array_equal(grown, region):
            return region
        region = grown


class _Window:
    """The last frames, at most ``n``."""

    def __init__(self, n_frames: int) -> None:
        if n_frames < 1:
            raise ValueError(f"a window of {n_frames} frames, must be at least 1")
        self._frames: deque[Values] = deque(maxlen=n_frames)

    def reset(self) -> None:
        """Forget all frames."""
        self._frames.clear()

    @property
    def full(self) -> bool:
        """Whether as many frames were seen as the window holds."""
        return len(self._frames) == self._frames.maxlen


class MovingMean(_Window):
    """Mean over the last n frames: settles completely after n frames."""

    def step(self, values: Values) -> Values:
        """Take a frame and return the mean over the window."""
        self._frames.append(values)
        mean: Values = np.mean(self._frames, axis=0)
        return mean


class MovingMedian(_Window):
    """Median over the last n frames: single outliers leave no trace."""

    def step(self, values: Values) -> Values:
        """Take a frame and return the median over the window."""
        self._frames.append(values)
        result: Values = np.median(self._frames, axis=0)
        return result


class ExponentialFilter:
    """First-order low-pass that knows when its frames were taken.

    Parameters
    ----------
    time_constant_s
        After this time a step has come to 63 %.
    """

    def __init__(self, time_constant_s: float) -> None:
        if not time_constant_s > 0.0:
            raise ValueError(f"time constant is {time_constant_s} s, must be above 0")
        self._time_constant_s = time_constant_s
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self._state: tuple[float, Values] | None = None

    def step(self, values: Values, t_s: float) -> Values:
        """Take a frame of time ``t_s`` and return the filtered values; time must not go back."""
        if self._state is None:
            filtered = values.copy()
        else:
            last_t_s, last = self._state
            if t_s < last_t_s:
                raise ValueError(f"frame of {t_s} s comes after one of {last_t_s} s")
            share = -np.expm1(-(t_s - last_t_s) / self._time_constant_s)
            filtered = last + share * (values - last)
        self._state = (t_s, filtered)
        return filtered
