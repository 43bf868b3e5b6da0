"""Quadric of a contact patch: fitted height field, the paper's form (7), and its transformations.

The surface is z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k. Written as P^T Q P = 0 with
P = (x, y, z, 1) and the scale fixed by 2 j = -1::

        | a d 0  g  |
    Q = | d b 0  h  |        j = -1/2
        | 0 0 0  j  |
        | g h j  k  |

so that k is the fitted height at the origin, in the unit of the heights. Homogeneous
transformations and the congruence that carries a quadric along (paper eq. (2)) are batched: leading
dimensions are broadcast, the last two hold one 4x4 matrix. Angles are in rad; lengths are in the
unit of the quadric's coordinates.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import QuadricError, TransformError

J = -0.5
"""The entry j of every height-field matrix: 2 j = -1."""
_MAX_CONDITION = 1e6
"""Largest condition number of the design matrix of a fit, in centred and scaled coordinates."""
MIN_POINTS = 7
"""Six unknowns and one point to judge the fit by."""


def _identities(shape: tuple[int, ...]) -> NDArray[np.float64]:
    out = np.zeros((*shape, 4, 4))
    out[..., range(4), range(4)] = 1.0
    return out


def translation(offset: ArrayLike) -> NDArray[np.float64]:
    """Return translations; ``offset`` has shape (..., 3), the result (..., 4, 4)."""
    offset = np.asarray(offset, dtype=np.float64)
    if offset.ndim < 1 or offset.shape[-1] != 3:
        raise TransformError(f"offset has shape {offset.shape}, expected (..., 3)")
    out = _identities(offset.shape[:-1])
    out[..., :3, 3] = offset
    return out


def scaling(factor: ArrayLike) -> NDArray[np.float64]:
    """Return uniform scalings; ``factor`` has shape (...), must not be 0."""
    factor = np.asarray(factor, dtype=np.float64)
    if np.any(factor == 0):
        raise TransformError("a scale factor is 0: the transformation has no inverse")
    out = _identities(factor.shape)
    for axis in range(3):
        out[..., axis, axis] = factor
    return out


def _rotation(angle_rad: ArrayLike, first: int, second: int) -> NDArray[np.float64]:
    angle = np.asarray(angle_rad, dtype=np.float64)
    out = _identities(angle.shape)
    cosine, sine = np.cos(angle), np.sin(angle)
    out[..., first, first] = cosine
    out[..., second, second] = cosine
    out[..., first, second] = -sine
    out[..., second, first] = sine
    return out


def rotation_x(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return right-handed rotations about x; ``angle_rad`` has shape (...)."""
    return _rotation(angle_rad, 1, 2)


def rotation_y(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return right-handed rotations about y; ``angle_rad`` has shape (...)."""
    return _rotation(angle_rad, 2, 0)


def rotation_z(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return right-handed rotations about z; ``angle_rad`` has shape (...)."""
    return _rotation(angle_rad, 0, 1)


def rotation_xyz(angle_rad: ArrayLike) -> NDArray[np.float64]:
    """Return Rz Ry Rx (about x first); ``angle_rad`` has shape (..., 3): x, y, z."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    if angle.ndim < 1 or angle.shape[-1] != 3:
        raise TransformError(f"angle_rad has shape {angle.shape}, expected (..., 3)")
    return rotation_z(angle[..., 2]) @ rotation_y(angle[..., 1]) @ rotation_x(angle[..., 0])


def by_inverse(Q: NDArray[np.float64], M_inv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Carry quadrics along with the points, P' = M P: Q' = M^-T Q M^-1 (paper eq. (2)).

    Parameters
    ----------
    Q : (..., 4, 4)
        Symmetric property matrices.
    M_inv : (..., 4, 4)
        M^-1; broadcast against ``Q``.

    Returns
    -------
    (..., 4, 4) float64
        Exactly symmetric. Rank and signature are those of ``Q``; the eigenvalues are only where
        M is orthogonal, that is for a rotation about the origin.
    """
    out: NDArray[np.float64] = np.swapaxes(M_inv, -1, -2) @ Q @ M_inv
    return 0.5 * (out + np.swapaxes(out, -1, -2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Quadric:
    """A fitted height field."""

    Q: NDArray[np.float64]
    """(4, 4) float64: form (7), read-only. x and y are (position - centre_m) / scale_m, z is the
    height."""
    residual: float
    """Weighted root mean square of the height error, in the unit of the heights."""
    condition: float
    """Condition number of the weighted design matrix."""
    n_points: int
    """Points of positive weight."""
    centre_m: NDArray[np.float64]
    """(2,) float64: weighted centroid of the points in the pad's plane, read-only."""
    scale_m: float
    """Weighted root-mean-square distance of the points from the centre."""

    def __post_init__(self) -> None:
        for name, shape in (("Q", (4, 4)), ("centre_m", (2,))):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != shape or not np.all(np.isfinite(array)):
                raise QuadricError(f"{name} is not a finite array of shape {shape}: {array}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def height(self) -> float:
        """Fitted height at the centre: k."""
        return float(self.Q[3, 3])


def height_field_matrix(
    *, a: float, b: float, d: float = 0.0, g: float = 0.0, h: float = 0.0, k: float
) -> NDArray[np.float64]:
    """Write z = a x^2 + b y^2 + 2 d xy + 2 g x + 2 h y + k as (4, 4) in the form (7)."""
    return np.array(
        [[a, d, 0.0, g], [d, b, 0.0, h], [0.0, 0.0, 0.0, J], [g, h, J, k]], dtype=np.float64
    )


def fit_height_field(
    xy_m: ArrayLike,
    height: ArrayLike,
    weight: ArrayLike | None = None,
) -> Quadric:
    """Fit the height field by weighted linear least squares.

    Parameters
    ----------
    xy_m : (n, 2)
        Positions in m.
    height : (n,)
        Heights in any one unit; counts by default in this package.
    weight : (n,), optional
        Weight of each squared residual, >= 0; 1 where not given.

    Raises
    ------
    QuadricError
        For shapes that do not fit, values that are not finite, negative weights, fewer than 7
        points of positive weight, or points that do not span the six unknowns: all on one line,
        on two parallel rows, or on any other conic.
    """
    xy, z, w = _checked(xy_m, height, weight)
    n = int(np.count_nonzero(w))
    if n < MIN_POINTS:
        raise QuadricError(f"{n} points, a height field needs at least {MIN_POINTS}")
    w = w / w.sum()
    centre = w @ xy
    scale = float(np.sqrt(w @ np.sum((xy - centre) ** 2, axis=1)))
    if not scale > 0:
        raise QuadricError(f"all {n} points are at one place")
    x, y = ((xy - centre) / scale).T
    root = np.sqrt(w)
    design = np.stack([x * x, y * y, 2 * x * y, 2 * x, 2 * y, np.ones_like(x)], axis=1)
    u, singular, vt = np.linalg.svd(design * root[:, None], full_matrices=False)
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else float("inf")
    if not condition <= _MAX_CONDITION:
        raise QuadricError(
            f"{n} points do not determine a height field: condition {condition:.3g}, limit "
            f"{_MAX_CONDITION:.3g}; they lie on a line, on two rows or on another conic"
        )
    a, b, d, g, h, k = vt.T @ ((u.T @ (z * root)) / singular)
    residual = float(np.sqrt(w @ (design @ (a, b, d, g, h, k) - z) ** 2))
    return Quadric(
        Q=height_field_matrix(a=a, b=b, d=d, g=g, h=h, k=k),
        residual=residual,
        condition=condition,
        n_points=n,
        centre_m=centre,
        scale_m=scale,
    )


def _checked(
    xy_m: ArrayLike, height: ArrayLike, weight: ArrayLike | None
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    xy = np.asarray(xy_m, dtype=np.float64)
    z = np.asarray(height, dtype=np.float64)
    w = np.ones(z.shape) if weight is None else np.asarray(weight, dtype=np.float64)
    if xy.ndim != 2 or xy.shape[1] != 2 or z.shape != (len(xy),) or w.shape != z.shape:
        raise QuadricError(f"points {xy.shape}, heights {z.shape}, weights {w.shape} do not fit")
    if not all(np.all(np.isfinite(array)) for array in (xy, z, w)):
        raise QuadricError("points, heights or weights have values that are not finite")
    if np.any(w < 0):
        raise QuadricError(f"a weight is negative: {float(w.min()):.3g}")
    return xy, z, w
