"""Homogeneous transformations and the congruence that carries a quadric along (paper eq. (2)).

All functions are batched: leading dimensions are broadcast, the last two hold one 4x4 matrix.
Angles are in rad; lengths are in the unit of the quadric's coordinates.
"""

from functools import reduce

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import TransformError

DEFAULT_ORDER = "TRS"
"""M = T R S: a point is scaled first, then rotated, then translated."""


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


def denavit_hartenberg(
    theta_rad: ArrayLike, d: ArrayLike, a: ArrayLike, alpha_rad: ArrayLike
) -> NDArray[np.float64]:
    """Return Rz(theta) Tz(d) Tx(a) Rx(alpha), the classic Denavit-Hartenberg matrix.

    The four arguments are broadcast against each other, the result has shape (..., 4, 4). It
    cannot express a scaling, which the paper's Algorithm 1 needs besides.
    """
    theta, d, a, alpha = np.broadcast_arrays(theta_rad, d, a, alpha_rad)
    along = translation(np.stack([a, np.zeros_like(a), d], axis=-1))
    return rotation_z(theta) @ along @ rotation_x(alpha)


def compose(
    *,
    translate: NDArray[np.float64],
    rotate: NDArray[np.float64],
    scale: NDArray[np.float64],
    order: str = DEFAULT_ORDER,
) -> NDArray[np.float64]:
    """Multiply the three in the given order, read as a product: "TRS" is M = T R S."""
    by_letter = {"T": translate, "R": rotate, "S": scale}
    return reduce(np.matmul, [by_letter[letter] for letter in check_order(order)])


def check_order(order: str) -> str:
    """Return ``order`` if it is a permutation of the letters T, R and S."""
    if sorted(order) != ["R", "S", "T"]:
        raise TransformError(f"order is {order!r}, expected a permutation of 'TRS'")
    return order


def invert(M: ArrayLike, *, max_condition: float = 1e12) -> NDArray[np.float64]:
    """Invert homogeneous matrices of shape (..., 4, 4).

    Raises
    ------
    TransformError
        Where a matrix is not finite, its last row is not (0, 0, 0, 1), or its condition number
        exceeds ``max_condition``.
    """
    M = np.asarray(M, dtype=np.float64)
    if M.ndim < 2 or M.shape[-2:] != (4, 4):
        raise TransformError(f"M has shape {M.shape}, expected (..., 4, 4)")
    if not np.all(np.isfinite(M)):
        raise TransformError("M has values that are not finite")
    if np.any(np.abs(M[..., 3, :] - (0.0, 0.0, 0.0, 1.0)) > 1e-12):
        raise TransformError("the last row of M is not (0, 0, 0, 1)")
    condition = float(np.max(np.linalg.cond(M[..., :3, :3]), initial=1.0))
    if not condition <= max_condition:
        raise TransformError(f"M has condition number {condition:.3g}, limit {max_condition:.3g}")
    return np.linalg.inv(M)


def congruence(Q: ArrayLike, M: ArrayLike) -> NDArray[np.float64]:
    """Carry quadrics along with the points: Q' = M^-T Q M^-1 (paper eq. (2)).

    Parameters
    ----------
    Q : (..., 4, 4)
        Symmetric property matrices.
    M : (..., 4, 4)
        Maps points: P' = M P; broadcast against ``Q``.

    Returns
    -------
    (..., 4, 4) float64
        Exactly symmetric. Rank and signature are those of ``Q``; the eigenvalues are only where
        M is orthogonal, that is for a rotation about the origin.

    Raises
    ------
    TransformError
        Where M has no inverse, see `invert`.
    """
    return by_inverse(np.asarray(Q, dtype=np.float64), invert(M))


def by_inverse(Q: NDArray[np.float64], M_inv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Apply `congruence` where M^-1 is already known and good."""
    out: NDArray[np.float64] = np.swapaxes(M_inv, -1, -2) @ Q @ M_inv
    return 0.5 * (out + np.swapaxes(out, -1, -2))
