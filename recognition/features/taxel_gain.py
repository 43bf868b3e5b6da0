"""Taxel gains: gain of each taxel against its neighbours, from the taught grasps.

Taxels of one pad differ by tens of per cent, and a patch that has moved by one taxel then looks
like another patch. Under a smooth pressure the logarithm of a taxel lies midway between those of
its neighbours; by how much it does not, over all grasps that load the three, is its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.features.footprint import PadGrid
from recognition.ramp.levels import Levels

_MIN_VALUE = 0.03
"""Least value of a loaded taxel as a share of full scale: below, rounding moves its logarithm."""
_NOISE_SIGMAS = 6.0
"""The same in standard deviations of the noise."""
_MIN_GRASPS = 8
"""Fewest grasps that load three taxels in a row for their bend to count."""
_HALF_WEIGHT_GRASPS = 20
"""Grasps at which a bend has half of its full weight."""
_RIDGE = 1.0
"""Ridge that draws gains towards 1 where few bends show them."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaxelGains:
    """Gains of the taxels of the gripping pads.

    Attributes
    ----------
    pads : tuple of (n_taxels_of_pad,) float64
        Each taxel reads this many times what it would if it were like its neighbours.
    """

    pads: tuple[NDArray[np.float64], ...]

    def undo(self, levels: Levels) -> Levels:
        """Return the grasps as pads of equal taxels would have read them."""
        maps = tuple(m / gain for m, gain in zip(levels.maps, self.pads, strict=True))
        return replace(levels, maps=maps)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays."""
        return {f"taxel_gain_{pad}": gain for pad, gain in enumerate(self.pads)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], n_pads: int) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(pads=tuple(arrays[f"taxel_gain_{pad}"] for pad in range(n_pads)))


def learn_taxel_gains(levels: Levels, grids: Sequence[PadGrid]) -> TaxelGains:
    """Return taxel gains from grasps at their full load; taxels that few of them load have gain 1.

    Gains that change smoothly over a pad are left out: they may be those of the objects.
    """
    return TaxelGains(
        pads=tuple(
            np.exp(_log_gains(m[:, -1], levels.noise[:, -1, pad], grid.shape))
            for pad, (m, grid) in enumerate(zip(levels.maps, grids, strict=True))
        )
    )


def _log_gains(
    maps: NDArray[np.float64], noise: NDArray[np.float64], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the logarithm of each taxel's gain, (n_taxels,), for one pad."""
    n = shape[0] * shape[1]
    values = maps.reshape(-1, *shape)
    loaded = values > np.maximum(_MIN_VALUE, _NOISE_SIGMAS * noise)[:, None, None]
    logs = np.log(np.maximum(values, 1e-6))
    index = np.arange(n).reshape(shape)
    rows: list[NDArray[np.float64]] = []
    excess: list[float] = []
    weights: list[float] = []
    for axis in (1, 2):
        # Three in a row, along and across the finger.
        before, middle, after = (_part(logs, axis, k) for k in range(3))
        seen = np.logical_and.reduce([_part(loaded, axis, k) for k in range(3)])
        taxels = [_part(index[None], axis, k)[0] for k in range(3)]
        bend = middle - 0.5 * (before + after)
        for place in np.ndindex(*bend.shape[1:]):
            use = seen[(slice(None), *place)]
            count = int(use.sum())
            if count < _MIN_GRASPS:
                continue
            row = np.zeros(n)
            row[[int(t[place]) for t in taxels]] = (-0.5, 1.0, -0.5)
            rows.append(row)
            excess.append(float(np.median(bend[(use, *place)])))
            weights.append(count / (count + _HALF_WEIGHT_GRASPS))
    if not rows:
        return np.zeros(n)
    design, weight = np.array(rows), np.array(weights)
    # The mean bend is that of the patches themselves.
    right = np.array(excess) - np.average(excess, weights=weight)
    weighted = design.T * weight
    gains = np.linalg.solve(weighted @ design + _RIDGE * np.eye(n), weighted @ right)
    known = np.abs(design).sum(axis=0) > 0
    return np.where(known, gains - _smooth_part(gains, known, shape), 0.0)


def _part(values: NDArray[Any], axis: int, k: int) -> NDArray[Any]:
    """Return the first, middle or last of each three in a row along an axis of (n, rows, cols)."""
    length = values.shape[axis]
    part: NDArray[Any] = values.take(np.arange(k, max(k, length - 2 + k)), axis=axis)
    return part


def _smooth_part(
    gains: NDArray[np.float64], known: NDArray[np.bool_], shape: tuple[int, int]
) -> NDArray[np.float64]:
    """Return the quadratic surface over the pad that is nearest to the known gains."""
    x, y = (
        axis.ravel() / max(length - 1, 1) - 0.5
        for axis, length in zip(np.indices(shape), shape, strict=True)
    )
    surface = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=1)
    smooth: NDArray[np.float64] = (
        surface @ np.linalg.lstsq(surface[known], gains[known], rcond=None)[0]
    )
    return smooth
