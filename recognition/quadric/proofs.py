"""The paper's argument in numbers: equations (4) to (6) and (8) to (10), solvers, five dimensions.

A quotient v.P v / v.N v over v = (x, 1) is given by two symmetric matrices P and N, (n, n) float64.
"""

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from recognition.errors import QuadricError
from recognition.quadric.quadric import J, by_inverse

Array = NDArray[np.float64]
_EPS = float(np.finfo(np.float64).eps)
_MOST_HALVINGS = 200
"""Most steps of a bisection: more than float64 has bits."""
_POWER_STEPS = 60
"""Steps of the power method."""


def _is_definite(A: Array) -> bool:
    try:
        linalg.cholesky(A, lower=True, check_finite=False)
    except linalg.LinAlgError:
        return False
    return True


def sdp_bound(P: Array, N: Array) -> float:
    """Solve the semidefinite program of eq. (5), max alpha with P - alpha N >= 0, by bisection.

    No eigenvalue is used. For two quadratic polynomials the bound is the infimum of eq. (4). Raises
    QuadricError where N is not positive definite: then the quotient has no infimum.
    """
    if not _is_definite(N):
        raise QuadricError("the denominator is not positive definite: no infimum is defined")
    high = float(np.min(np.diag(P) / np.diag(N)))
    width = max(abs(high), float(np.abs(P).max() / np.diag(N).max()), np.finfo(float).tiny)
    for _ in range(_MOST_HALVINGS):
        if _is_definite(P - (high - width) * N):
            break
        width *= 2.0
    else:
        raise QuadricError("no feasible alpha: the denominator is nearly singular")
    low = high - width
    while high - low > _EPS * max(abs(low), abs(high)):
        middle = 0.5 * (low + high)
        if not low < middle < high:
            break
        low, high = (middle, high) if _is_definite(P - middle * N) else (low, middle)
    return low


def least_quotient(P: Array, N: Array) -> float:
    """Return the least value of the quotient of eq. (4) that descents from eight points reach."""
    n = len(P) - 1

    def quotient(x: Array) -> tuple[float, Array]:
        v = np.append(x, 1.0)
        below = float(v @ N @ v)
        value = float(v @ P @ v) / below
        return value, 2.0 * ((P - value * N) @ v)[:n] / below

    starts = np.random.default_rng(0).normal(size=(8, n)) * np.geomspace(0.1, 100.0, 8)[:, None]
    return min(
        float(optimize.minimize(quotient, x, jac=True, method="BFGS", options={"gtol": 1e-12}).fun)
        for x in starts
    )


def column_sums(M_inv: Array) -> Array:
    """Return the diagonal matrix (..., 4, 4) that eq. (8) has in the place of M^-1."""
    sums = M_inv.sum(axis=-2)
    return np.asarray(sums[..., None] * np.eye(sums.shape[-1]))


def substituted(Q: Array, M_inv: Array) -> tuple[Array, Array]:
    """Return numerator and denominator of eq. (9): v is replaced by M^-1 v in both.

    The quotient then runs through the same values, so its infimum is that of Q for each M.
    """
    return by_inverse(Q, M_inv), by_inverse(np.eye(4), M_inv)


def ramp_surface(xy: Array, share: Array, height: Array) -> Array:
    """Fit the 5x5 form with the grip force as fifth coordinate: P = (x, y, z, w, 1).

    Parameters
    ----------
    xy, share, height
        (n, 2), (n,) and (n,) float64: places, part w of the full force, and heights there.
    """
    x, y = xy.T
    w = share
    columns = [x * x, y * y, 2 * x * y, 2 * x * w, 2 * y * w, w * w, 2 * x, 2 * y, 2 * w, w**0]
    a, b, d, g, h, k, l, m, n, o = np.linalg.lstsq(np.stack(columns, axis=1), height)[0]  # noqa: E741
    rows = [[a, d, 0, g, l], [d, b, 0, h, m], [0, 0, 0, 0, J], [g, h, 0, k, n], [l, m, J, n, o]]
    return np.array(rows, dtype=np.float64)


# Solvers: each takes (n, 4, 4) matrices in their own precision and returns min |lambda|, (n,).


def _coefficients(Q: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the characteristic polynomial, highest power first (Faddeev and Le Verrier)."""
    n, M = Q.shape[-1], np.zeros_like(Q)
    out = np.ones((len(Q), n + 1), dtype=Q.dtype)
    for k in range(1, n + 1):
        M = Q @ M + out[:, k - 1, None, None] * np.eye(n, dtype=Q.dtype)
        out[:, k] = -np.trace(Q @ M, axis1=1, axis2=2) / Q.dtype.type(k)
    return out


def _polynomial(Q: NDArray[np.floating]) -> Array:
    """Find the root of the polynomial near 0 by Newton's method, with its coefficients' type."""
    c, x = _coefficients(Q), np.zeros(len(Q), dtype=Q.dtype)
    for _ in range(_POWER_STEPS):
        value, slope = np.ones_like(x), np.zeros_like(x)
        for k in range(1, c.shape[1]):
            slope, value = slope * x + value, value * x + c[:, k]
        x = x - value / np.where(slope == 0, np.finfo(Q.dtype).tiny, slope)
    return np.abs(x)


def _qr(Q: NDArray[np.floating]) -> Array:
    return np.array([np.abs(linalg.eigvals(one, check_finite=False)).min() for one in Q])


def _companion(Q: NDArray[np.floating]) -> Array:
    c, C = _coefficients(Q), np.zeros_like(Q)
    C[:, 0, :] = -c[:, 1:]
    C[:, range(1, Q.shape[-1]), range(Q.shape[-1] - 1)] = 1
    return _qr(C)


def _power(Q: NDArray[np.floating]) -> Array:
    """Iterate v <- Q^-1 v with the inverse, then take Rayleigh's quotient."""
    inverse, v = np.linalg.inv(Q), np.ones((len(Q), Q.shape[-1], 1), dtype=Q.dtype)
    for _ in range(_POWER_STEPS):
        v = inverse @ v
        v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.abs(1 / (np.swapaxes(v, 1, 2) @ inverse @ v)[:, 0, 0])


def _symmetric_qr(Q: NDArray[np.floating]) -> Array:
    return np.array([np.abs(linalg.eigvalsh(one, check_finite=False)).min() for one in Q])


SOLVERS: Mapping[str, Callable[[NDArray[np.floating]], Array]] = MappingProxyType(
    {
        "characteristic polynomial": _polynomial,
        "companion matrix": _companion,
        "power method on the inverse": _power,
        "QR (eigvals)": _qr,
        "symmetric QR (eigvalsh)": _symmetric_qr,
    }
)
"""The solvers of section 3 of the paper, by name."""


def precise_smallest(Q: Array) -> Array:
    """Return min |lambda| of symmetric matrices (n, n, n) in extended precision, as (n,) float64.

    Rayleigh's quotient of an eigenvector has the square of its error.
    """
    values, vectors = np.linalg.eigh(Q)
    place = np.argmin(np.abs(values), axis=1)
    v = np.take_along_axis(vectors, place[:, None, None], axis=2).astype(np.longdouble)
    quotient = np.swapaxes(v, 1, 2) @ Q.astype(np.longdouble) @ v
    return np.abs(quotient / (np.swapaxes(v, 1, 2) @ v))[:, 0, 0].astype(np.float64)
