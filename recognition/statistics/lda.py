"""Linear discriminant analysis (LDA) with a shrunken covariance."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh
from scipy.sparse import csr_array

from recognition.records import ArrayRecord

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
