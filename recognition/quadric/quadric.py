"""Quadric of a contact patch: fitted height field, the paper's form (7), and its transformations.

The surface is z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k. Written as P^T Q P = 0 with
P = (x, y, z, 1) and the scale fixed by 2 j = -1::

        | a d 0  g  |
    Q = | d b 0  h  |        j = -1/2
        | 0 0 0  j  |
        | g h j  k  |

so that k is the fitted height at the origin, in the unit of the heights. Homogeneous
transformations and the congruence of a quadric (paper eq. (2)) are batched: leading dimensions are
broadcast, the last two have one 4x4 matrix. Angles are in rad; lengths are in the unit of the
quadric's coordinates.

The paper's feature is the smallest eigenvalue of Q. The paper's numbers allow two readings of
"smallest"; each has its own name here. The solver is LAPACK's symmetric QR in
``numpy.linalg.eigvalsh``. Its error is of the order of eps * max|lambda|. On a spectrum from 1e-3
to 1e2 this is about 2e-11 relative to min|lambda|.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from recognition.errors import QuadricError, TransformError

J = -0.5
"""The entry j of every height-field matrix: 2 j = -1."""
_MAX_CONDITION = 1e6
"""Largest condition number of the design matrix of a fit, in centred and scaled coordinates."""
MIN_POINTS = 7
"""Fewest points of a fit: six unknowns and one more."""
_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""


def translation(offset: ArrayLike) -> NDArray[np.float64]:
    """Return translations; ``offset`` has shape (..., 3), the result (..., 4, 4)."""
    offset = np.asarray(offset, dtype=np.float64)
    out = np.tile(np.eye(4), (*offset.shape[:-1], 1, 1))
    out[..., :3, 3] = offset
    return out


def scaling(factor: ArrayLike) -> NDArray[np.float64]:
    """Return uniform scalings; ``factor`` has shape (...), must not be 0."""
    factor = np.asarray(factor, dtype=np.float64)
    if np.any(factor == 0):
        raise TransformError("a scale factor is 0: the transformation has no inverse")
    out = factor[..., None, None] * np.eye(4)
    out[..., 3, 3] = 1.0
    return out


def rotation_xyz(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return Rz Ry Rx (about x first), right-handed; ``angle_rad`` has shape (..., 3): x, y, z."""
    angle_rad = np.asarray(angle_rad, dtype=np.float64)
    out = np.tile(np.eye(4), (*angle_rad.shape[:-1], 1, 1))
    turns = Rotation.from_euler("xyz", angle_rad.reshape(-1, 3))
    out[..., :3, :3] = turns.as_matrix().reshape(*angle_rad.shape[:-1], 3, 3)
    return out


def by_inverse(Q: NDArray[np.float64], M_inv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Transform quadrics with the points, P' = M P: Q' = M^-T Q M^-1 (paper eq. (2)).

    Parameters
    ----------
    Q : (..., 4, 4)
        Symmetric property matrices.
    M_inv : (..., 4, 4)
        M^-1; broadcast against ``Q``.

    Returns
    -------
    (..., 4, 4) float64
        Exactly symmetric. Rank and signature are those of ``Q``. The eigenvalues are those of ``Q``
        only if M is orthogonal, so for a rotation about the origin.
    """
    out: NDArray[np.float64] = np.swapaxes(M_inv, -1, -2) @ Q @ M_inv
    return 0.5 * (out + np.swapaxes(out, -1, -2))


def height_field_matrix(
    *, a: float, b: float, d: float = 0.0, g: float = 0.0, h: float = 0.0, k: float
) -> NDArray[np.float64]:
    """Write z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k as (4, 4) in the form (7)."""
    return np.array(
        [[a, d, 0.0, g], [d, b, 0.0, h], [0.0, 0.0, 0.0, J], [g, h, J, k]], dtype=np.float64
    )


def fit_height_field(xy_m: NDArray[np.float64], height: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit the height field by linear least squares.

    Raises QuadricError for fewer than 7 points, or points that do not determine the six unknowns:
    on one line, on two parallel rows, or on any other conic.

    Parameters
    ----------
    xy_m : (n, 2)
        Positions in m.
    height : (n,)
        Heights in any one unit; counts by default in this package.

    Returns
    -------
    (4, 4) float64
        Form (7). x and y are measured from the centroid of the points, in units of their root mean
        square distance from it; z is the height.
    """
    n = len(xy_m)
    if n < MIN_POINTS:
        raise QuadricError(f"{n} points, a height field needs at least {MIN_POINTS}")
    share = np.full(n, 1.0 / n)
    centre = share @ xy_m
    scale = float(np.sqrt(share @ np.sum((xy_m - centre) ** 2, axis=1)))
    if not scale > 0:
        raise QuadricError(f"all {n} points have one position")
    x, y = ((xy_m - centre) / scale).T
    root = np.sqrt(share)
    design = np.stack([x * x, y * y, 2 * x * y, 2 * x, 2 * y, np.ones_like(x)], axis=1)
    u, singular, vt = np.linalg.svd(design * root[:, None], full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
    if not condition <= _MAX_CONDITION:
        raise QuadricError(
            f"{n} points do not determine a height field: condition {condition:.3g}, limit "
            f"{_MAX_CONDITION:.3g}; they lie on a line, on two rows or on another conic"
        )
    a, b, d, g, h, k = vt.T @ ((u.T @ (height * root)) / singular)
    return height_field_matrix(a=a, b=b, d=d, g=g, h=h, k=k)


class Reading(StrEnum):
    """Readings of "the smallest eigenvalue"."""

    SMALLEST_MAGNITUDE = "smallest_magnitude"
    """min|lambda|: "of order 1e-3, the largest 1e2", last when sorted by falling magnitude."""
    ALGEBRAIC_MINIMUM = "algebraic_minimum"
    """lambda_1, the infimum of the Rayleigh quotient, eq. (3) to (6); <= 0 for a real surface."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmallestEigenvalue:
    """Smallest eigenvalues of a batch."""

    value: NDArray[np.float64]
    """(...) float64: in the unit of the matrix; never below the floor of rounding in the readings
    that are magnitudes."""
    degenerate: NDArray[np.bool_]
    """(...) bool: true if the value is rounding noise, so the matrix may be singular. Its magnitude
    is then not above n * eps * max|lambda|, n the size of the matrix."""


def smallest_eigenvalue(
    Q: NDArray[np.float64], reading: Reading = Reading.SMALLEST_MAGNITUDE
) -> SmallestEigenvalue:
    """Return the smallest eigenvalue of each property matrix.

    Parameters
    ----------
    Q : (..., 4, 4)
        Symmetric matrices.
    reading
        Kind of the smallest; the paper's numbers fit only the smallest magnitude.
    """
    values = np.asarray(np.linalg.eigvalsh(Q), dtype=np.float64)
    n = values.shape[-1]
    magnitudes = np.abs(values)
    floor = n * _EPS * np.maximum(magnitudes[..., 0], magnitudes[..., -1])
    if reading is Reading.ALGEBRAIC_MINIMUM:
        value = values[..., 0]
        return SmallestEigenvalue(value=value, degenerate=np.abs(value) <= floor)
    magnitude = magnitudes[..., 0]
    for column in range(1, n):  # faster over long batches than a minimum along a short axis
        magnitude = np.minimum(magnitude, magnitudes[..., column])
    return SmallestEigenvalue(value=np.maximum(magnitude, floor), degenerate=magnitude <= floor)
