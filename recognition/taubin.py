"""Fit a general quadric to points in space by Taubin's method (IEEE PAMI 13:1115, 1991).

Minimises p^T M p / p^T N p with M = sum d d^T and N = sum (grad d)(grad d)^T over the design row
d = (x^2, y^2, z^2, 2xy, 2yz, 2xz, 2x, 2y, 2z, 1): the mean squared distance to first order, which
does not depend on the pose or the scale of the points.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from recognition.eigen import check_symmetric
from recognition.errors import QuadricError
from recognition.transform import congruence, scaling, translation

MIN_POINTS = 10
"""Nine free unknowns and one point to judge the fit by."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FreeQuadric:
    """A general quadric through points.

    Attributes
    ----------
    Q : (4, 4) float64
        Property matrix in the coordinates of the points; unit Frobenius norm, trace of the 3x3
        block >= 0. Read-only.
    residual_m
        Root mean square distance to first order, in the unit of the points.
    separation
        Second smallest over smallest generalised eigenvalue: near 1 the fit is arbitrary.
    n_points
        Points used.
    """

    Q: NDArray[np.float64]
    residual_m: float
    separation: float
    n_points: int

    def __post_init__(self) -> None:
        Q = np.array(self.Q, dtype=np.float64)
        Q.setflags(write=False)
        object.__setattr__(self, "Q", Q)


def normalised(Q: ArrayLike) -> NDArray[np.float64]:
    """Scale property matrices (..., 4, 4) to unit Frobenius norm, trace of the 3x3 block >= 0.

    Where that trace vanishes, the last diagonal entry k is made <= 0.
    """
    Q = check_symmetric(Q)
    norm = np.linalg.norm(Q, axis=(-1, -2), keepdims=True)
    if not np.all(norm > 0):
        raise QuadricError("a property matrix is zero")
    unit = Q / norm
    trace = np.trace(unit[..., :3, :3], axis1=-2, axis2=-1)
    decisive = np.where(np.abs(trace) > 1e-12, trace, -unit[..., 3, 3])
    signed: NDArray[np.float64] = unit * np.where(decisive < 0, -1.0, 1.0)[..., None, None]
    return signed


def fit_taubin(points_m: ArrayLike, *, min_separation: float = 1.5) -> FreeQuadric:
    """Fit a general quadric.

    Parameters
    ----------
    points_m : (n, 3)
        Points in m, at least ten.
    min_separation
        Least ratio of the second smallest to the smallest generalised eigenvalue.

    Raises
    ------
    QuadricError
        For too few points, values that are not finite, points in a plane or on a curve, and
        points that several quadrics fit alike.
    """
    points = np.asarray(points_m, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise QuadricError(f"points have shape {points.shape}, expected (n, 3)")
    n = len(points)
    if n < MIN_POINTS:
        raise QuadricError(f"{n} points, a general quadric needs at least {MIN_POINTS}")
    if not np.all(np.isfinite(points)):
        raise QuadricError("points have values that are not finite")
    centre = points.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((points - centre) ** 2, axis=1))))
    if not scale > 0:
        raise QuadricError(f"all {n} points are at one place")
    M, N = _taubin_matrices((points - centre) / scale)
    # the constant term has no gradient: it is eliminated (M's last entry is 1, the mean of 1*1)
    reduced = M[:9, :9] - np.outer(M[:9, 9], M[9, :9])
    gradient = np.linalg.eigvalsh(N)
    if not gradient[0] > 1e-10 * gradient[-1]:
        raise QuadricError(f"{n} points lie in a plane or on a line: no gradient to normalise by")
    values, vectors = scipy.linalg.eigh(reduced, N)
    rounding = 1e-13 * float(np.trace(reduced)) / float(gradient[0])
    smallest, second = max(float(values[0]), 0.0), float(values[1])
    if not second > max(min_separation * smallest, rounding):
        raise QuadricError(
            f"{n} points do not determine a quadric: the two best fits have errors "
            f"{smallest:.3g} and {second:.3g}, ratio below {min_separation:g}"
        )
    p = np.append(vectors[:, 0], -M[9, :9] @ vectors[:, 0])
    to_points = translation(centre) @ scaling(scale)
    return FreeQuadric(
        Q=normalised(congruence(_as_matrix(p), to_points)),
        residual_m=float(np.sqrt(smallest)) * scale,
        separation=second / smallest if smallest > 0 else float("inf"),
        n_points=n,
    )


def _taubin_matrices(
    points: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return M (10, 10) and the part of N (9, 9) that is not zero, both as means over points."""
    x, y, z = points.T
    one, nil = np.ones_like(x), np.zeros_like(x)
    design = np.stack([x * x, y * y, z * z, 2 * x * y, 2 * y * z, 2 * x * z])
    design = np.concatenate([design, 2 * points.T, one[None]])
    along_x = np.stack([2 * x, nil, nil, 2 * y, nil, 2 * z, 2 * one, nil, nil])
    along_y = np.stack([nil, 2 * y, nil, 2 * x, 2 * z, nil, nil, 2 * one, nil])
    along_z = np.stack([nil, nil, 2 * z, nil, 2 * y, 2 * x, nil, nil, 2 * one])
    n = len(points)
    return design @ design.T / n, sum(g @ g.T for g in (along_x, along_y, along_z)) / n


def _as_matrix(p: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b, c, d, e, f, g, h, j, k = p
    return np.array([[a, d, f, g], [d, b, e, h], [f, e, c, j], [g, h, j, k]])
