"""The paper's feature: the smallest eigenvalue of a property matrix, batched.

The paper's numbers allow two readings of "smallest"; each has its own name here. The solver is
LAPACK's symmetric QR in ``numpy.linalg.eigvalsh``. Its error is of the order of eps * max|lambda|.
On a spectrum from 1e-3 to 1e2 this is about 2e-11 relative to min|lambda|.
"""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

_EPS = float(np.finfo(np.float64).eps)
"""Relative rounding of float64."""


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


def eigenvalues(Q: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return all eigenvalues, ascending, of symmetric matrices (..., 4, 4); shape (..., 4)."""
    return np.asarray(np.linalg.eigvalsh(Q), dtype=np.float64)


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
    values = eigenvalues(Q)
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
