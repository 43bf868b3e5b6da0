"""The paper's infimum argument, equations (4) to (10), as numbers that can be compared.

The argument: the smallest eigenvalue is the infimum of Rayleigh's quotient p(x) / q(x) over the
points x of space, and that is the largest alpha for which p - alpha q is a sum of squares
(eq. (5), a semidefinite program). Both are solved here without any eigenvalue, so that they can
stand beside ``eigvalsh``.

Of equations (8) to (10) there are three pencils (numerator, denominator): what is
printed, with column sums in place of the product; the true product in numerator and denominator;
and the quotient of the transformed matrix, which is what Algorithm 1 computes.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg, optimize

from recognition.errors import QuadricError
from recognition.quadric.eigen import check_symmetric
from recognition.quadric.quadric import by_inverse

_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""
_MAX_HALVINGS = 200
"""Most steps of the bisection for alpha: more than float64 has bits."""

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Pencil:
    """A quotient v.P v / v.N v of two quadratic polynomials in x, v = (x, 1)."""

    P: Array
    N: Array
    """(n, n) float64: numerator and denominator, symmetric."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SdpBound:
    """The largest alpha with P - alpha N positive semidefinite, enclosed."""

    feasible: float
    """Largest value at which Cholesky's factorisation was found."""
    infeasible: float
    """Smallest value at which there is none."""
    n_factorisations: int
    """How many were tried."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Approached:
    """A value of the quotient found by descent."""

    value: float
    """The least value found."""
    x: Array
    """(n - 1,) float64: point where it stands; far out where the infimum is only approached."""


def _has_cholesky(A: Array) -> bool:
    try:
        linalg.cholesky(A, lower=True, check_finite=False)
    except linalg.LinAlgError:
        return False  # documented answer: not positive definite
    return True


def sdp_bound(pencil: Pencil) -> SdpBound:
    """Solve the semidefinite program of eq. (5) by bisection on feasibility.

    For two quadratic polynomials the relaxation is exact: the bound is the infimum.

    Raises
    ------
    QuadricError
        Where the denominator is not positive definite: the quotient has no infimum.
    """
    P, N = check_symmetric(pencil.P), check_symmetric(pencil.N)
    if not _has_cholesky(N):
        raise QuadricError("the denominator is not positive definite: no infimum is defined")
    # no diagonal entry may become negative: an upper end that needs no solving
    high = float(np.min(np.diag(P) / np.diag(N)))
    width = max(abs(high), float(np.abs(P).max() / np.diag(N).max()), np.finfo(float).tiny)
    count = 1
    while not _has_cholesky(P - (high - width) * N):
        width *= 2.0
        count += 1
        if count > _MAX_HALVINGS:
            raise QuadricError("no feasible alpha found: the denominator is all but singular")
    low = high - width
    for _ in range(_MAX_HALVINGS):
        middle = 0.5 * (low + high)
        if not low < middle < high or high - low <= _EPS * max(abs(low), abs(high)):
            break
        count += 1
        if _has_cholesky(P - middle * N):
            low = middle
        else:
            high = middle
    return SdpBound(feasible=low, infeasible=high, n_factorisations=count)


def approach_infimum(pencil: Pencil, *, n_starts: int = 8, seed: int = 0) -> Approached:
    """Descend the quotient over points x from several starts (eq. (4)), an upper bound.

    Where the infimum lies at infinity it is approached along a direction.
    """
    P, N = check_symmetric(pencil.P), check_symmetric(pencil.N)
    n = len(P) - 1

    def quotient(x: Array) -> tuple[float, Array]:
        v = np.append(x, 1.0)
        numerator, denominator = float(v @ P @ v), float(v @ N @ v)
        value = numerator / denominator
        return value, 2.0 * ((P - value * N) @ v)[:n] / denominator

    rng = np.random.default_rng(seed)
    best = Approached(value=np.inf, x=np.zeros(n))
    for start in rng.normal(size=(n_starts, n)) * np.geomspace(0.1, 100.0, n_starts)[:, None]:
        found = optimize.minimize(quotient, start, jac=True, method="BFGS", options={"gtol": 1e-12})
        if float(found.fun) < best.value:
            best = Approached(value=float(found.fun), x=np.asarray(found.x, dtype=np.float64))
    return best


def column_sums(M_inv: ArrayLike) -> Array:
    """Return A, B, C, D of eq. (8): the column sums of M^-1, (..., 4)."""
    found: Array = np.asarray(M_inv, dtype=np.float64).sum(axis=-2)
    return found


def printed_image(M_inv: ArrayLike, P: ArrayLike) -> Array:
    """Return (A x, B y, C z, D), what eq. (8) writes for M^-1 P; points are (..., 4)."""
    found: Array = column_sums(M_inv) * np.asarray(P, dtype=np.float64)
    return found


def true_image(M_inv: ArrayLike, P: ArrayLike) -> Array:
    """Return the product M^-1 P of matrices (..., 4, 4) and points (..., 4)."""
    M_inv, P = np.asarray(M_inv, dtype=np.float64), np.asarray(P, dtype=np.float64)
    found: Array = np.einsum("...ij,...j->...i", M_inv, P)
    return found


def printed_pencil(Q: ArrayLike, M_inv: ArrayLike) -> Pencil:
    """Return eq. (9) as printed: column sums in numerator and denominator."""
    diagonal = np.diag(column_sums(M_inv))
    return Pencil(P=diagonal @ check_symmetric(Q) @ diagonal, N=diagonal @ diagonal)


def substituted_pencil(Q: ArrayLike, M_inv: ArrayLike) -> Pencil:
    """Return eq. (9) with the true product: v replaced by M^-1 v above and below.

    Its infimum is that of Q for every M: the same quotient over the same points, named otherwise.
    """
    M_inv = np.asarray(M_inv, dtype=np.float64)
    return Pencil(P=by_inverse(check_symmetric(Q), M_inv), N=by_inverse(np.eye(4), M_inv))
