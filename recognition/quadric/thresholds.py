"""Levels, thresholds and windows: the decision of the paper's Algorithm 1.

Each object has a band of values. Between neighbouring bands is a window (A, B, C, ... in the
paper's Fig. 4), with the threshold at its middle. If bands overlap, the window is closed and
gives no name.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import TrajectoryError
from recognition.grasp import keep_array

NOISE_SHARE = 0.08
"""Widening of bands as a share of the level: the paper's noise of levels, 8 %."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LevelBands:
    """Bands of the taught objects, with thresholds and windows between them."""

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    """(n_objects,) float64: band of each object; NaN if an object has no level."""
    margin: float = NOISE_SHARE
    """Share of its edge by which a band is extended into open space."""

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            keep_array(self, name, getattr(self, name))

    @property
    def order(self) -> NDArray[np.int64]:
        """(n_levels,) int64: objects with a level, by the middle of their band, ascending."""
        order = np.argsort(0.5 * (self.low + self.high), kind="stable")
        return order[np.isfinite(self.low[order])]

    @property
    def threshold(self) -> NDArray[np.float64]:
        """(n_levels - 1,) float64: middle between the bands of neighbours in ``order``."""
        return 0.5 * (self.high[self.order[:-1]] + self.low[self.order[1:]])

    @property
    def window(self) -> NDArray[np.float64]:
        """(n_levels - 1,) float64: gap between them; closed if it is not above 0."""
        return np.asarray(self.low[self.order[1:]] - self.high[self.order[:-1]])

    def distance(self, value: float) -> NDArray[np.float64]:
        """Return the distance of a value from each band, (n_objects,); 0 inside, NaN: no level."""
        return np.maximum(np.maximum(self.low - value, value - self.high), 0.0)

    def reach(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the bands widened by the margin, low and high, (n_objects,) each."""
        return self.low - self.margin * np.abs(self.low), self.high + self.margin * np.abs(
            self.high
        )


def find_thresholds(values: Sequence[ArrayLike]) -> LevelBands:
    """Turn the values of each object into bands, thresholds and windows.

    Raises TrajectoryError if no object has a level.

    Parameters
    ----------
    values
        Any number of values for each object; NaN is left out. An object without values has no level
        and is never named.
    """
    low = np.full(len(values), np.nan)
    high = np.full(len(values), np.nan)
    for index, one in enumerate(values):
        usable = np.asarray(one, dtype=np.float64).ravel()
        usable = usable[np.isfinite(usable)]
        if len(usable):
            low[index], high[index] = usable.min(), usable.max()
    if not np.isfinite(low).any():
        raise TrajectoryError(
            f"no object of {len(values)} has a level: no grasp pressed enough neighbouring taxels "
            "for a surface, which needs pads of at least 3 x 3"
        )
    return LevelBands(low=low, high=high)


def with_noise(levels: LevelBands, noise_share: float) -> LevelBands:
    """Adjust bands and windows to the measured noise, like the paper's windows A to D.

    Raises TrajectoryError if ``noise_share`` is not from 0 below 1.

    Parameters
    ----------
    levels
        Bands without noise.
    noise_share
        Present relative uncertainty of a level.

    Returns
    -------
    LevelBands
        Bands are wider and windows narrower by this amount; a window may be closed. The margin is
        at least the noise.
    """
    if not 0.0 <= noise_share < 1.0:
        raise TrajectoryError(f"noise_share is {noise_share}, must be from 0 below 1")
    low = levels.low - noise_share * np.abs(levels.low)
    high = levels.high + noise_share * np.abs(levels.high)
    return LevelBands(low=low, high=high, margin=max(levels.margin, noise_share))


def check_level(levels: LevelBands, value: float) -> int | None:
    """Return the object whose band contains a value.

    Inside one band it is that object, inside several (a closed window) none. Between bands the
    threshold decides, within the extended bands.

    Returns
    -------
    int or None
        Index of the object; None for unknown.
    """
    distance = levels.distance(value)
    inside = np.flatnonzero(distance == 0.0)
    if len(inside):
        return int(inside[0]) if len(inside) == 1 else None
    low, high = levels.reach()
    near = np.flatnonzero((value >= low) & (value <= high))
    if not len(near):
        return None
    nearest = near[distance[near] == distance[near].min()]
    return int(nearest[0]) if len(nearest) == 1 else None
