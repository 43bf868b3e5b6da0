"""Sizes of the taught grasps: how far the size of a grasp lies from all that were taught."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.statistics.lda import squared_distances

_PRIOR_MM = 0.5
"""Expected distance in mm of the size of a grasp from the nearest one of the same object."""
_PRIOR_GRASPS = 4.0
"""Weight of that expectation, in grasps: the unit comes from the grasps where there are more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaughtSizes:
    """Sizes of the taught grasps.

    Attributes
    ----------
    sizes_mm : (n, k) float64
        The sizes; k is 0 where none is known, and nothing is far from any size then.
    unit_mm
        Usual distance in mm from a grasp to the nearest one of the same object.
    """

    sizes_mm: NDArray[np.float64]
    unit_mm: float

    def novelty(self, sizes_mm: NDArray[np.float64], zero_sd_mm: float) -> NDArray[np.float64]:
        """Return (n,): how far sizes (n, k) lie from the nearest taught grasp; 0 on its place.

        It is the logarithm of 1 plus the squared distance in units, to be added to the logarithm
        of another squared distance. ``zero_sd_mm`` is the standard deviation in mm of the zero of
        the opening since teaching.
        """
        nearest_mm2 = squared_distances(sizes_mm, self.sizes_mm).min(axis=1)
        unit_mm2 = self.unit_mm**2 + zero_sd_mm**2
        return np.asarray(np.log1p(nearest_mm2 / unit_mm2), dtype=np.float64)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {f"{prefix}mm": self.sizes_mm, f"{prefix}unit_mm": np.array(self.unit_mm)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(sizes_mm=arrays[f"{prefix}mm"], unit_mm=float(arrays[f"{prefix}unit_mm"]))


def fit_sizes(sizes_mm: NDArray[np.float64], classes: NDArray[np.int64]) -> TaughtSizes:
    """Return the sizes (n, k) of grasps with classes (n,); their unit is known after many grasps.

    The unit is the root of the mean square of the distances, drawn towards an expected one.
    """
    squared = squared_distances(sizes_mm, sizes_mm)
    squared[(classes[:, None] != classes) | np.eye(len(classes), dtype=np.bool_)] = np.inf
    nearest_mm2 = squared.min(axis=1)
    nearest_mm2 = nearest_mm2[np.isfinite(nearest_mm2)]
    total_mm2 = _PRIOR_GRASPS * _PRIOR_MM**2 + float(nearest_mm2.sum())
    unit_mm = np.sqrt(total_mm2 / (_PRIOR_GRASPS + len(nearest_mm2)))
    return TaughtSizes(sizes_mm=sizes_mm, unit_mm=float(unit_mm))
