"""Linear discriminant analysis (LDA) with a shrunken covariance, and classes beyond their means.

The covariance of a class is between that of its grasps and the shared one. A size is compared with
the nearest one among the taught grasps of an object.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import csr_array

from recognition.records import ArrayRecord

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


_RANK_TOLERANCE = 1e-9
"""Singular values of the means below this share of the largest one are 0."""
_SPREAD_FLOOR = 1e-2
"""Least unit of a feature, as a share of its deviation over all grasps: rounding must not count as
variation."""
_DIAGONAL_FLOOR = 1e-9
"""Added to the diagonal of the covariance, in squared units of the features: none is 0."""
_LEAST_VARIANCE = 1e-9
"""Variance along an axis, over that of the target, below which the grasps do not vary."""
_AT_A_TIME = 4096
"""Rows centred at a time."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LinearDiscriminant(ArrayRecord):
    """Gaussian classes with one covariance, in the space that separates them."""

    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    """(F,) float64: features are centred and scaled by these before all else. The target of the
    covariance is then the identity."""
    projection: NDArray[np.float64]
    """(F, r) float64: from scaled features to the discriminant space, where each class has unit
    covariance."""
    centres: NDArray[np.float64]
    """(C, r) float64: classes in the discriminant space."""
    variation: NDArray[np.float64]
    """(F, k) float64: axes along which the taught grasps of a class vary. With the variance v on an
    axis above that of the target, its length is sqrt(v / (1 + v)). In units of the covariance, the
    squared length of scaled features y is y @ y - (y @ variation)^2 (Woodbury)."""

    def project(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, r): features (n, F) in the discriminant space."""
        projection = self.projection / self.scale[:, None]
        projected: NDArray[np.float64] = features @ projection
        projected -= self.mean @ projection
        return projected


def squared_distances(
    points: NDArray[np.float64], others: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (n, m) squared distances between points (n, r) and others (m, r)."""
    squared = (points**2).sum(axis=1)[:, None] + (others**2).sum(axis=1)
    squared -= 2.0 * (points @ others.T)
    return np.asarray(np.maximum(squared, 0.0, out=squared), dtype=np.float64)


def fit_lda(
    features: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
    *,
    min_shrinkage: float = 0.0,
    target: NDArray[np.float64] | None = None,
    nuisance: NDArray[np.float64] | None = None,
    least_unit: float = 0.0,
    most_axes: int | None = None,
) -> LinearDiscriminant:
    """Fit a linear discriminant to labelled rows.

    The covariance is shrunken by the oracle approximating shrinkage (Chen et al. 2010, eq. 23),
    which falls with the number of rows. Raises ValueError unless there are more rows than classes
    and each class has a row.

    Parameters
    ----------
    features : (n, F)
        Finite features.
    classes : (n,)
        Class of each row, 0 to n_classes - 1; each class at least once.
    n_classes
        Number of classes C.
    min_shrinkage
        The least share of the target in the covariance, 0 to 1.
    target : (F,)
        Diagonal of the target; None for the identity.
    nuisance : (m, F)
        Further deviations; the mean of their squares is added to the covariance.
    least_unit
        Deviation added to that of each feature, in its unit: few rows may show too little
        variation.
    most_axes
        The most axes r of several classes: those that separate best; None for all.
    """
    n, n_features = features.shape
    count = np.bincount(classes, minlength=n_classes).astype(np.float64)
    if n <= n_classes or np.any(count == 0):
        raise ValueError(
            f"{n} grasps of {n_classes} objects do not show the variation of one object: "
            "teach each object at least three times"
        )
    members = csr_array((np.ones(n), (classes, np.arange(n))), shape=(n_classes, n))
    means = (members @ features) / count[:, None]
    # The features of all grasps need much memory: this is the only copy.
    within = features.copy()
    for begin in range(0, n, _AT_A_TIME):
        within[begin : begin + _AT_A_TIME] -= means[classes[begin : begin + _AT_A_TIME]]
    mean = means.mean(axis=0)
    freedom = float(n - n_classes)
    between = count @ (means - count @ means / n) ** 2
    # The unit of a feature is its deviation within a class; 1 for a constant one.
    squares = np.einsum("nf,nf->f", within, within)
    nuisance = np.zeros((1, n_features)) if nuisance is None else nuisance
    spread = np.sqrt(squares / freedom + (nuisance**2).mean(axis=0))
    units = np.sqrt(spread**2 + _SPREAD_FLOOR**2 * ((squares + between) / n))
    scale = np.hypot(np.where(units > 1e-12, units, 1.0), least_unit)
    within /= scale
    covariance = within.T @ within / freedom
    rho = max(min_shrinkage, _oas(covariance, n - n_classes))
    deviation = nuisance / scale
    covariance += deviation.T @ deviation / len(deviation)
    level = float(np.trace(covariance)) / n_features
    target = np.ones(n_features) if target is None else target
    unit = np.sqrt(rho * level * target + _DIAGONAL_FLOOR)
    scale *= unit
    variance, axes = eigh((1.0 - rho) * covariance / np.outer(unit, unit))
    variance, axes = variance[variance > _LEAST_VARIANCE], axes[:, variance > _LEAST_VARIANCE]
    stretch = 1.0 / np.sqrt(1.0 + variance) - 1.0

    def whiten(rows: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(rows + rows @ axes * stretch @ axes.T, dtype=np.float64)

    if n_classes == 1:
        # One class has nothing to separate from: distances are those in the whole whitened space.
        projection, centres = whiten(np.eye(n_features)), np.zeros((1, n_features))
    else:
        # The means span a few axes of the whitened space, which separate the classes.
        offsets = (means - mean) / scale
        _, spread, apart = np.linalg.svd(whiten(offsets), full_matrices=False)
        rank = int(np.sum(spread > _RANK_TOLERANCE * max(float(spread[0]), 1e-300)))
        if rank == 0:
            raise ValueError("the objects have the same mean: check their labels")
        projection = whiten(apart[: min(rank, most_axes or rank)]).T
        centres = offsets @ projection
    return LinearDiscriminant(
        mean=mean,
        scale=scale,
        projection=projection,
        centres=centres,
        variation=axes * np.sqrt(variance / (1.0 + variance)),
    )


def _oas(covariance: NDArray[np.float64], freedom: int) -> float:
    """Return the oracle approximating shrinkage, 0 to 1 (Chen et al. 2010, eq. 23)."""
    p = len(covariance)
    trace2 = float(np.trace(covariance)) ** 2
    squares = float((covariance**2).sum())
    below = (freedom + 1 - 2 / p) * (squares - trace2 / p)
    if below <= 0:
        return 1.0
    return min(1.0, ((1 - 2 / p) * squares + trace2) / below)
