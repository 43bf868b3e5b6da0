"""Classes beyond their means: a covariance for each, and the sizes of the taught grasps.

The covariance of a class is between that of its grasps and the shared one. A size is compared with
the nearest one among the taught grasps of an object.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.records import ArrayRecord
from recognition.statistics.lda import squared_distances

_SHARED_GRASPS = 15.0
"""Weight of the shared covariance in that of a class, in grasps."""
_PAIRS = 1 << 14
"""Pairs of a point and a class that are computed at once: more would not fit into the caches."""
_MOST_AXES = 48
"""Number of axes, those that separate best: more cost time and memory."""
_PRIOR_MM = (0.5, 0.2)
"""Expected distance in mm of a grasp from the nearest one of the same object: of the opening under
full load, which depends on the force, and of the opening at the first touch."""
_SIZE_GRASPS = 4.0
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
class ClassSpread(ArrayRecord):
    """Covariances of C classes in a space where the shared covariance is the identity."""

    centres: NDArray[np.float64]
    """(C, k) float64: the classes along the first k axes."""
    precision: NDArray[np.float32]
    """(C, k, k) float32: inverse of the covariance of each class along these axes."""
    log_volume: NDArray[np.float64]
    """(C,) float64: half the logarithm of its determinant."""

    def distances(
        self,
        z: NDArray[np.float64],
        plain: NDArray[np.float64],
        classes: NDArray[np.int64] | slice = slice(None),
    ) -> NDArray[np.float64]:
        """Return (n, K) squared distances of points to some classes, by the covariance of each.

        `z` (n, r) are the points, `plain` (n, K) their squared distances by the shared covariance.
        """
        centres, n_axes = self.centres[classes, None], self.centres.shape[1]
        beyond = self.precision[classes] - np.eye(n_axes)
        n_rows = max(1, _PAIRS // len(centres))
        offs = (
            z[start : start + n_rows, :n_axes] - centres
            for start in range(0, max(1, len(z)), n_rows)
        )
        added = np.concatenate([((off @ beyond) * off).sum(axis=-1).T for off in offs])
        return np.asarray(np.maximum(plain + added, 0.0), dtype=np.float64)


def fit_class_spread(
    z: NDArray[np.float64], classes: NDArray[np.int64], centres: NDArray[np.float64]
) -> ClassSpread:
    """Return the spread of points z (n, r) with classes (n,) about their centres (C, r)."""
    centres = centres[:, :_MOST_AXES]
    off = z[:, : centres.shape[1]] - centres[classes]
    # Taught grasps are closer to their centre than later ones; only the form counts here.
    off = off / max(float(np.sqrt((off**2).mean())), 1e-6)
    shared = _SHARED_GRASPS * np.eye(centres.shape[1])
    covariance = np.stack(
        [
            (shared + off[classes == c].T @ off[classes == c])
            / (_SHARED_GRASPS + np.count_nonzero(classes == c))
            for c in range(len(centres))
        ]
    )
    return ClassSpread(
        centres=centres,
        precision=np.linalg.inv(covariance).astype(np.float32),
        log_volume=0.5 * np.linalg.slogdet(covariance)[1],
    )


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
    total_mm2 = _SIZE_GRASPS * np.array(_PRIOR_MM[: sizes_mm.shape[1]]) ** 2
    total_mm2 = total_mm2 + _WITHOUT_LARGEST * np.concatenate(usual_mm2).sum(axis=0)
    unit_mm = np.sqrt(total_mm2 / (_SIZE_GRASPS + sum(map(len, usual_mm2))))
    inner = np.concatenate([_inner(sizes_mm / unit_mm, classes == c) for c in np.unique(classes)])
    return TaughtSizes(mm=sizes_mm[inner], classes=classes[inner], unit_mm=unit_mm)


def _inner(sizes: NDArray[np.float64], members: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the rows of one object without its most isolated sizes (n, k), `_OUTER_SHARE`."""
    rows = np.flatnonzero(members)
    n_outer = int(_OUTER_SHARE * len(rows))
    to_others = np.sort(squared_distances(sizes[rows], sizes[rows]), axis=1)
    lonely = to_others[:, min(1 + n_outer, len(rows) - 1)]
    return rows[np.argsort(lonely, kind="stable")[: len(rows) - n_outer]]
