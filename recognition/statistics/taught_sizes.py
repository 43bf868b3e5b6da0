"""Sizes of the taught grasps, and the distance of a grasp's size from those of an object."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.records import ArrayRecord
from recognition.statistics.lda import squared_distances

_PRIOR_MM = (0.5, 0.2)
"""Expected distance in mm of a grasp from the nearest one of the same object: of the opening under
full load, which depends on the force, and of the opening at the first touch."""
_PRIOR_GRASPS = 4.0
"""Weight of that expectation, in grasps; with more grasps these decide."""
_LEAST_UNIT_MM = 1e-6
"""Least usual distance in mm in a model file: the expectation gives much more."""
_WITHOUT_LARGEST = 2.0
"""Mean square of these distances over that without the largest one of each object, about, for
random neighbours. With few grasps of a box, the only one on another side is millimetres from the
others. As a usual distance it would hide differences between objects."""
_OUTER_SHARE = 0.1
"""Share of the grasps of an object, the most isolated, that are left out. Of many grasps, for
example of a drawing on all possible foams, some have the size of another object."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaughtSizes(ArrayRecord):
    """Sizes of the taught grasps."""

    mm: NDArray[np.float64]
    """(n, k) float64: sizes without outliers, of `recognition.features.sizes_mm`. If the
    opening is not used, k is 0 and all distances are 0."""
    classes: NDArray[np.int64]
    """(n,) int64: object of each, ascending."""
    unit_mm: NDArray[np.float64]
    """(k,) float64: usual distance in mm from a grasp to the nearest one of the same object."""

    def __post_init__(self) -> None:
        if not np.all(self.unit_mm > _LEAST_UNIT_MM):
            raise ValueError(f"unit_mm is {self.unit_mm}, must be above {_LEAST_UNIT_MM:g}")

    def distances(
        self,
        sizes_mm: NDArray[np.float64],
        slack_mm: NDArray[np.float64],
        objects: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Return (n, G, O): squared distance in units of sizes (n, O, k) to the nearest taught one.

        ``slack_mm`` (O,) adds to the units. ``objects`` (n, G, O) are those compared with.
        """
        squared = np.zeros(objects.shape)
        unit_mm2 = self.unit_mm**2 + slack_mm[:, None, None] ** 2
        for c in np.unique(objects):
            rows = np.flatnonzero((objects == c).any(axis=(1, 2)))
            own = slice(*np.searchsorted(self.classes, (c, c + 1)))
            off_mm = sizes_mm[rows, :, None] - self.mm[own]
            nearest = (off_mm**2 / unit_mm2).sum(axis=-1).min(axis=-1)
            squared[rows] = np.where(objects[rows] == c, nearest[:, None], squared[rows])
        return squared


def fit_sizes(sizes_mm: NDArray[np.float64], classes: NDArray[np.int64]) -> TaughtSizes:
    """Return the sizes (n, k) of grasps with classes (n,), at least two of each class.

    The units are root mean squares of the usual distances, shrunk towards the expected ones.
    """
    usual_mm2 = []
    for c in np.unique(classes):
        own_mm = sizes_mm[classes == c]
        off_mm = np.abs(own_mm[:, None] - own_mm)
        off_mm[np.diag_indices(len(own_mm))] = np.inf
        usual_mm2.append(np.sort(off_mm.min(axis=1) ** 2, axis=0)[:-1])
    total_mm2 = _PRIOR_GRASPS * np.array(_PRIOR_MM[: sizes_mm.shape[1]]) ** 2
    total_mm2 = total_mm2 + _WITHOUT_LARGEST * np.concatenate(usual_mm2).sum(axis=0)
    unit_mm = np.sqrt(total_mm2 / (_PRIOR_GRASPS + sum(map(len, usual_mm2))))
    inner = np.concatenate([_inner(sizes_mm / unit_mm, classes == c) for c in np.unique(classes)])
    return TaughtSizes(mm=sizes_mm[inner], classes=classes[inner], unit_mm=unit_mm)


def _inner(sizes: NDArray[np.float64], members: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the rows of one object without its most isolated sizes (n, k), `_OUTER_SHARE`."""
    rows = np.flatnonzero(members)
    n_outer = int(_OUTER_SHARE * len(rows))
    to_others = np.sort(squared_distances(sizes[rows], sizes[rows]), axis=1)
    lonely = to_others[:, min(1 + n_outer, len(rows) - 1)]
    return rows[np.argsort(lonely, kind="stable")[: len(rows) - n_outer]]
