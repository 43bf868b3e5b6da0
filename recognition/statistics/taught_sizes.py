"""Sizes of the taught grasps: how far the size of a grasp lies from all that were taught."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.statistics.lda import squared_distances

_PRIOR_MM = (0.5, 0.2)
"""Expected distance in mm of a grasp from the nearest one of the same object: of the opening under
the full load, which depends on the force, and of that at the first touch."""
_PRIOR_GRASPS = 4.0
"""Weight of that expectation, in grasps: the units come from the grasps where there are more."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaughtSizes:
    """Sizes of the taught grasps.

    Attributes
    ----------
    sizes_mm : (n, k) float64
        The sizes, as of `recognition.features.aperture.sizes_mm`; k is 0 where the opening is not
        used, and nothing is far from any size then.
    unit_mm : (k,) float64
        Usual distance in mm from a grasp to the nearest one of the same object.
    """

    sizes_mm: NDArray[np.float64]
    unit_mm: NDArray[np.float64]

    def novelty(self, sizes_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n,): how far sizes (n, k) lie from the nearest taught grasp; 0 on its place.

        It is the logarithm of 1 plus the squared distance in units, to be added to the logarithm
        of another squared distance.
        """
        unit = self.unit_mm
        nearest = squared_distances(sizes_mm / unit, self.sizes_mm / unit).min(axis=1)
        return np.asarray(np.log1p(nearest), dtype=np.float64)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {f"{prefix}mm": self.sizes_mm, f"{prefix}unit_mm": self.unit_mm}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(sizes_mm=arrays[f"{prefix}mm"], unit_mm=arrays[f"{prefix}unit_mm"])


def fit_sizes(sizes_mm: NDArray[np.float64], classes: NDArray[np.int64]) -> TaughtSizes:
    """Return the sizes (n, k) of grasps with classes (n,), of which each has at least two.

    The units are root mean squares of the distances, drawn towards the expected ones.
    """
    off_mm = np.abs(sizes_mm[:, None] - sizes_mm)
    off_mm[(classes[:, None] != classes) | np.eye(len(classes), dtype=np.bool_)] = np.inf
    nearest_mm2 = off_mm.min(axis=1) ** 2
    total_mm2 = _PRIOR_GRASPS * np.array(_PRIOR_MM[: sizes_mm.shape[1]]) ** 2
    total_mm2 = total_mm2 + nearest_mm2.sum(axis=0)
    unit_mm = np.sqrt(total_mm2 / (_PRIOR_GRASPS + len(sizes_mm)))
    return TaughtSizes(sizes_mm=sizes_mm, unit_mm=unit_mm)
