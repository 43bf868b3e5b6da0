"""The paper's feature: the smallest eigenvalue of a property matrix, batched.

"Smallest" has three readings in the paper; each is here under its own name. The solver is LAPACK's
symmetric QR through ``numpy.linalg.eigvalsh``: its error is of the order of eps * max|lambda|, so
relative to min|lambda| about 2e-11 on a spectrum from 1e-3 to 1e2.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import QuadricError

_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""


class Reading(StrEnum):
    """Which eigenvalue is meant by "the smallest"."""

    SMALLEST_MAGNITUDE = "smallest_magnitude"
    """min|lambda|: "of order 1e-3, the largest 1e2", last when sorted by falling magnitude."""
    ALGEBRAIC_MINIMUM = "algebraic_minimum"
    """lambda_1, the infimum of the Rayleigh quotient, eq. (3) to (6); <= 0 for a real surface."""
    COVARIANCE = "covariance"
    """The smallest eigenvalue of Q^T Q, which is min|lambda| squared (text of Fig. 3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmallestEigenvalue:
    """Smallest eigenvalues of a batch."""

    value: NDArray[np.float64]
    """(...) float64: in the unit of the matrix; never below the floor of rounding in the readings
    that are magnitudes."""
    degenerate: NDArray[np.bool_]
    """(...) bool: true where the value is rounding noise: its magnitude is not above n * eps *
    max|lambda|, n the size of the matrix, so that the matrix may as well be singular."""


def check_symmetric(Q: ArrayLike) -> NDArray[np.float64]:
    """Return Q as float64 of shape (..., n, n), n = 4 or 5, made exactly symmetric.

    Raises
    ------
    QuadricError
        Where the shape is another, a value is not finite, or Q and its transpose differ by more
        than 1e-9 of the largest entry.
    """
    Q = np.asarray(Q, dtype=np.float64)
    if Q.ndim < 2 or Q.shape[-2:] not in ((4, 4), (5, 5)):
        raise QuadricError(f"property matrix has shape {Q.shape}, expected (..., 4, 4) or 5 x 5")
    if not np.all(np.isfinite(Q)):
        raise QuadricError("property matrix has values that are not finite")
    transposed = np.swapaxes(Q, -1, -2)
    difference = np.abs(Q - transposed).max(axis=(-1, -2))
    largest = np.abs(Q).max(axis=(-1, -2))
    if np.any(difference > 1e-9 * largest):
        raise QuadricError(
            f"property matrix is not symmetric: entries differ by {float(difference.max()):.3g}"
        )
    symmetric: NDArray[np.float64] = 0.5 * (Q + transposed)
    return symmetric


def ascending(symmetric: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the eigenvalues of symmetric matrices (..., n, n) that need no more checks."""
    return np.asarray(np.linalg.eigvalsh(symmetric), dtype=np.float64)


def eigenvalues(Q: ArrayLike) -> NDArray[np.float64]:
    """Return all eigenvalues, ascending, of property matrices (..., n, n); shape (..., n)."""
    return ascending(check_symmetric(Q))


def smallest_of(
    values: NDArray[np.float64], reading: Reading = Reading.SMALLEST_MAGNITUDE
) -> SmallestEigenvalue:
    """Pick the smallest from eigenvalues of shape (..., n) in ascending order."""
    n = values.shape[-1]
    magnitudes = np.abs(values)
    floor = n * _EPS * np.maximum(magnitudes[..., 0], magnitudes[..., -1])
    if reading is Reading.ALGEBRAIC_MINIMUM:
        value = values[..., 0]
        return SmallestEigenvalue(value=value, degenerate=np.abs(value) <= floor)
    magnitude = magnitudes[..., 0]
    for column in range(1, n):  # faster over long batches than a minimum along a short axis
        magnitude = np.minimum(magnitude, magnitudes[..., column])
    degenerate = magnitude <= floor
    magnitude = np.maximum(magnitude, floor)
    if reading is Reading.COVARIANCE:
        magnitude = magnitude**2
    return SmallestEigenvalue(value=magnitude, degenerate=degenerate)


def smallest_eigenvalue(
    Q: ArrayLike, reading: Reading = Reading.SMALLEST_MAGNITUDE
) -> SmallestEigenvalue:
    """Return the smallest eigenvalue of each property matrix.

    Parameters
    ----------
    Q : (..., 4, 4) or (..., 5, 5)
        Symmetric matrices.
    reading
        Which one is meant; the paper's numbers fit the smallest magnitude alone.

    Raises
    ------
    QuadricError
        See `check_symmetric`.
    """
    return smallest_of(eigenvalues(Q), reading)
