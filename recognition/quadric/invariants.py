"""Invariants of a quadric under motion and scaling, and the change of the eigenvalue feature.

With A the 3x3 block of Q, b = (g, h, j) and k its last entry: I1, I2, I3 and D keep their values
under rigid motion, for a fixed scale of the coefficients. Under scaling x -> s x and Q -> mu Q only
functions of I1^2/I2 and I1 I2/I3 remain, the ratios of the squared axes.

The paper claims that the smallest eigenvalue is independent of rotation, translation and scale
(eq. (8) to (10), Fig. 3). `change_over` applies each kind alone, and all together, and solves each
matrix in full, without the shortcuts of the fast sweep.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import QuadricError, TrajectoryError
from recognition.quadric.eigen import (
    Reading,
    SmallestEigenvalue,
    ascending,
    check_symmetric,
    smallest_eigenvalue,
)
from recognition.quadric.quadric import by_inverse, congruence, rotation_xyz, scaling, translation
from recognition.quadric.sweep import points
from recognition.quadric.trajectory import PAPER_SWEEP, Axes, SweepSettings

_STILL = replace(PAPER_SWEEP, scale=np.ones(1), translation=np.zeros(1), angle_rad=np.zeros(1))
"""The grid of a single pose: none of the loops moves."""

TRANSFORMATIONS: Mapping[str, SweepSettings] = MappingProxyType(
    {
        "rotation": replace(_STILL, angle_rad=PAPER_SWEEP.angle_rad, rotation_axes=Axes.SEPARATE),
        "translation": replace(
            _STILL, translation=PAPER_SWEEP.translation, translation_axes=Axes.SEPARATE
        ),
        "scale": replace(_STILL, scale=PAPER_SWEEP.scale),
        "rotation, translation": replace(PAPER_SWEEP, scale=np.ones(1)),
        "all three loops": PAPER_SWEEP,
    }
)
"""The paper's grid by kind: three angles about the origin, x and y, scale; then together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """The smallest eigenvalue of one object under one kind of transformation.

    Attributes
    ----------
    at_rest
        Value of the matrix itself.
    least, greatest
        Extremes over the grid.
    n
        Poses.
    """

    at_rest: float
    least: float
    greatest: float
    n: int

    @property
    def relative(self) -> float:
        """Width of the values as a part of the value at rest."""
        return (self.greatest - self.least) / abs(self.at_rest)

    @property
    def factor(self) -> float:
        """Greatest over least, in magnitude."""
        low, high = sorted((abs(self.least), abs(self.greatest)))
        return high / low


def change_over(
    Q: ArrayLike, settings: SweepSettings, reading: Reading = Reading.SMALLEST_MAGNITUDE
) -> Change:
    """Apply every pose of a grid (M = T R S) to one property matrix and follow the eigenvalue.

    Raises
    ------
    TrajectoryError
        Where the matrix is not 4x4, or singular to rounding: it has no level to be followed.
    """
    Q = check_symmetric(Q)
    at_rest = smallest_eigenvalue(Q, reading)
    if Q.shape != (4, 4) or at_rest.degenerate:
        raise TrajectoryError(f"a matrix of shape {Q.shape} without a level cannot be followed")
    shift = points(settings.translation, 2, separate=settings.translation_axes is Axes.SEPARATE)
    turn = points(settings.angle_rad, 3, separate=settings.rotation_axes is Axes.SEPARATE)
    to_rest = (
        np.swapaxes(rotation_xyz(turn), -1, -2)
        @ translation(np.column_stack([-shift, np.zeros(len(shift))]))[:, None]
    )
    least, greatest, n = np.inf, -np.inf, 0
    for shrink in scaling(1.0 / settings.scale):
        value = smallest_eigenvalue(by_inverse(Q, shrink @ to_rest), reading).value
        least, greatest = min(least, float(value.min())), max(greatest, float(value.max()))
        n += value.size
    return Change(at_rest=float(at_rest.value), least=least, greatest=greatest, n=n)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Invariants:
    """Invariants of a batch of quadrics; every array has the shape of the batch.

    Attributes
    ----------
    i1, i2, i3
        Trace, sum of the principal 2x2 minors and determinant of A.
    d
        Determinant of Q.
    d2, d3
        Sums of the principal 2x2 and 3x3 minors of Q; translation changes them except for
        parallel planes (d2) and cylinders (d3).
    """

    i1: NDArray[np.float64]
    i2: NDArray[np.float64]
    i3: NDArray[np.float64]
    d: NDArray[np.float64]
    d2: NDArray[np.float64]
    d3: NDArray[np.float64]


def _elementary(values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the elementary symmetric functions e1..en of the last axis."""
    coefficients = [np.ones(values.shape[:-1])]
    for column in range(values.shape[-1]):
        value = values[..., column]
        grown = [*coefficients, np.zeros_like(value)]
        for order in range(1, len(grown)):
            grown[order] = grown[order] + value * coefficients[order - 1]
        coefficients = grown
    return coefficients[1:]


def _checked_4x4(Q: ArrayLike) -> NDArray[np.float64]:
    Q = check_symmetric(Q)
    if Q.shape[-1] != 4:
        raise QuadricError(f"property matrix has shape {Q.shape}, expected (..., 4, 4)")
    return Q


def invariants(Q: ArrayLike) -> Invariants:
    """Return the invariants of property matrices (..., 4, 4)."""
    Q = _checked_4x4(Q)
    i1, i2, i3 = _elementary(ascending(Q[..., :3, :3]))
    _, d2, d3, d = _elementary(ascending(Q))
    return Invariants(i1=i1, i2=i2, i3=i3, d=d, d2=d2, d3=d3)


def similarity_invariants(Q: ArrayLike) -> NDArray[np.float64]:
    """Return (I1^2 / I2, I1 I2 / I3), shape (..., 2); not finite where I2 or I3 vanish."""
    found = invariants(Q)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratios = [found.i1**2 / found.i2, found.i1 * found.i2 / found.i3]
    return np.stack(ratios, axis=-1)


def squared_semi_axes(Q: ArrayLike) -> NDArray[np.float64]:
    """Return a_i^2 = -D / (I3 lambda_i(A)), shape (..., 3), in squared length.

    Negative where the surface does not cross that axis.

    Raises
    ------
    QuadricError
        Where A is singular: the surface has no centre, or a whole line of them.
    """
    Q = _checked_4x4(Q)
    values = ascending(Q[..., :3, :3])
    _refuse_singular(values)
    # D / I3 is k at the centre, by Schur's complement: no product of small numbers needed
    at_centre = Q[..., 3, 3] - np.einsum(
        "...i,...i->...",
        Q[..., :3, 3],
        np.linalg.solve(Q[..., :3, :3], Q[..., :3, 3, None])[..., 0],
    )
    squared: NDArray[np.float64] = -at_centre[..., None] / values
    return squared


def cylinder_squared_radii(Q: ArrayLike) -> NDArray[np.float64]:
    """Return a_i^2 = -D3 / (I2 lambda_i(A)) of the two large lambda_i, shape (..., 2).

    Right for cylinders alone (I3 = D = 0), which is not checked.
    """
    Q = _checked_4x4(Q)
    found = invariants(Q)
    values = ascending(Q[..., :3, :3])
    order = np.argsort(-np.abs(values), axis=-1)[..., :2]
    large = np.sort(np.take_along_axis(values, order, axis=-1), axis=-1)
    return -found.d3[..., None] / (found.i2[..., None] * large)


def _refuse_singular(values: NDArray[np.float64]) -> None:
    magnitude = np.abs(values)
    if np.any(magnitude.min(axis=-1) <= 1e-12 * magnitude.max(axis=-1)):
        raise QuadricError(
            "the quadric has no single centre (its 3x3 block is singular); "
            "give the contact's centroid and a radius instead"
        )


def corrected_eigenvalue(
    Q: ArrayLike,
    reading: Reading = Reading.SMALLEST_MAGNITUDE,
    *,
    centre: ArrayLike | None = None,
    radius: ArrayLike | None = None,
) -> SmallestEigenvalue:
    """Return the paper's feature made independent of translation, rotation and scale.

    The origin is moved to the quadric's centre, lengths are divided by a radius and Q is scaled
    to k = -1. What remains depends on the ratios of the axes alone.

    Parameters
    ----------
    Q : (..., 4, 4)
        Property matrices.
    reading
        Which eigenvalue, see `recognition.quadric.eigen.Reading`.
    centre : (..., 3), optional
        Origin to use; the quadric's own centre where not given.
    radius : (...), optional
        Unit of length; the root mean square of the semi-axes' magnitudes where not given.

    Raises
    ------
    QuadricError
        Where the centre or the radius is not given and A is singular, or where k vanishes at the
        centre (a cone).
    """
    Q = _checked_4x4(Q)
    if radius is None:
        radius = np.sqrt(np.mean(np.abs(squared_semi_axes(Q)), axis=-1))
    if centre is None:
        _refuse_singular(ascending(Q[..., :3, :3]))
        centre = -np.linalg.solve(Q[..., :3, :3], Q[..., :3, 3, None])[..., 0]
    radius = np.asarray(radius, dtype=np.float64)
    if not np.all((radius > 0) & np.isfinite(radius)):
        raise QuadricError(f"radius is {radius}, must be above 0; a cone or a point has none")
    to_centre = scaling(1.0 / radius) @ translation(-np.asarray(centre, dtype=np.float64))
    moved = congruence(Q, to_centre)
    k = moved[..., 3, 3]
    if np.any(np.abs(k) <= 1e-12 * np.abs(moved).max(axis=(-1, -2))):
        raise QuadricError("k vanishes at the centre: the quadric is a cone or a point")
    return smallest_eigenvalue(moved / -k[..., None, None], reading)
