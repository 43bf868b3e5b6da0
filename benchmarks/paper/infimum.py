"""The paper's infimum argument, equations (4) to (10), as numbers that can be compared.

The argument: the smallest eigenvalue is the infimum of Rayleigh's quotient p(x) / q(x) over the
points x of space, and that is the largest alpha for which p - alpha q is a sum of squares
(eq. (5), a semidefinite program). Both are solved here without any eigenvalue, so that they can
stand beside ``eigvalsh``. A quotient v.P v / v.N v, v = (x, 1), is given by its two symmetric
matrices P and N, (n, n) float64.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, optimize

from recognition.errors import QuadricError
from recognition.quadric.quadric import by_inverse

_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""
_MAX_HALVINGS = 200
"""Most steps of the bisection for alpha: more than float64 has bits."""

Array = NDArray[np.float64]


def _has_cholesky(A: Array) -> bool:
    try:
        linalg.cholesky(A, lower=True, check_finite=False)
    except linalg.LinAlgError:
        return False  # documented answer: not positive definite
    return True


def sdp_bound(P: Array, N: Array) -> float:
    """Solve the semidefinite program of eq. (5) by bisection on feasibility.

    For two quadratic polynomials the relaxation is exact: the bound is the infimum.

    Raises
    ------
    QuadricError
        Where the denominator is not positive definite: the quotient has no infimum.
    """
    if not _has_cholesky(N):
        raise QuadricError("the denominator is not positive definite: no infimum is defined")
    # no diagonal entry may become negative: an upper end that needs no solving
    high = float(np.min(np.diag(P) / np.diag(N)))
    width = max(abs(high), float(np.abs(P).max() / np.diag(N).max()), np.finfo(float).tiny)
    for _ in range(_MAX_HALVINGS):
        if _has_cholesky(P - (high - width) * N):
            break
        width *= 2.0
    else:
        raise QuadricError("no feasible alpha found: the denominator is all but singular")
    low = high - width
    for _ in range(_MAX_HALVINGS):
        middle = 0.5 * (low + high)
        if not low < middle < high or high - low <= _EPS * max(abs(low), abs(high)):
            break
        if _has_cholesky(P - middle * N):
            low = middle
        else:
            high = middle
    return low


def approach_infimum(
    P: Array, N: Array, *, n_starts: int = 8, seed: int = 0
) -> tuple[float, Array]:
    """Descend the quotient over points from several starts (eq. (4)): its least value, and x.

    Where the infimum lies at infinity it is approached along a direction.
    """
    n = len(P) - 1

    def quotient(x: Array) -> tuple[float, Array]:
        v = np.append(x, 1.0)
        denominator = float(v @ N @ v)
        value = float(v @ P @ v) / denominator
        return value, 2.0 * ((P - value * N) @ v)[:n] / denominator

    starts = np.random.default_rng(seed).normal(size=(n_starts, n))
    found = [
        optimize.minimize(quotient, start, jac=True, method="BFGS", options={"gtol": 1e-12})
        for start in starts * np.geomspace(0.1, 100.0, n_starts)[:, None]
    ]
    best = min(found, key=lambda one: float(one.fun))
    return float(best.fun), best.x


def printed(Q: Array, M_inv: Array) -> tuple[Array, Array]:
    """Return eq. (9) as printed: column sums of M^-1, eq. (8), above and below the line."""
    diagonal = np.diag(M_inv.sum(axis=-2))
    return diagonal @ Q @ diagonal, diagonal @ diagonal


def substituted(Q: Array, M_inv: Array) -> tuple[Array, Array]:
    """Return eq. (9) with the true product: v replaced by M^-1 v above and below.

    Its infimum is that of Q for every M: the same quotient over the same points, named otherwise.
    """
    return by_inverse(Q, M_inv), by_inverse(np.eye(4), M_inv)
