"""The change of the eigenvalue feature under motion and scaling, and a feature that keeps.

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
    """The smallest eigenvalue of one object under one kind of transformation."""

    at_rest: float
    """Value of the matrix itself."""
    least: float
    greatest: float
    """Extremes over the grid."""
    n: int
    """Poses."""

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


def _checked_4x4(Q: ArrayLike) -> NDArray[np.float64]:
    Q = check_symmetric(Q)
    if Q.shape[-1] != 4:
        raise QuadricError(f"property matrix has shape {Q.shape}, expected (..., 4, 4)")
    return Q


def squared_semi_axes(Q: ArrayLike) -> NDArray[np.float64]:
    """Return a_i^2 = -det Q / (det A lambda_i(A)), A the 3x3 block of Q, shape (..., 3).

    Negative where the surface does not cross that axis.

    Raises
    ------
    QuadricError
        Where A is singular: the surface has no centre, or a whole line of them.
    """
    Q = _checked_4x4(Q)
    values = ascending(Q[..., :3, :3])
    _refuse_singular(values)
    # det Q / det A is k at the centre, by Schur's complement: no product of small numbers needed
    at_centre = Q[..., 3, 3] - np.einsum(
        "...i,...i->...",
        Q[..., :3, 3],
        np.linalg.solve(Q[..., :3, :3], Q[..., :3, 3, None])[..., 0],
    )
    squared: NDArray[np.float64] = -at_centre[..., None] / values
    return squared


def _refuse_singular(values: NDArray[np.float64]) -> None:
    magnitude = np.abs(values)
    if np.any(magnitude.min(axis=-1) <= 1e-12 * magnitude.max(axis=-1)):
        raise QuadricError("the quadric has no single centre (its 3x3 block is singular)")


def corrected_eigenvalue(
    Q: ArrayLike, reading: Reading = Reading.SMALLEST_MAGNITUDE
) -> SmallestEigenvalue:
    """Return the paper's feature made independent of translation, rotation and scale.

    The origin is moved to the quadric's centre, lengths are divided by the root mean square of the
    semi-axes' magnitudes, and Q is scaled to k = -1. What remains depends on the ratios of the axes
    alone.

    Parameters
    ----------
    Q : (..., 4, 4)
        Property matrices.
    reading
        Which eigenvalue, see `recognition.quadric.eigen.Reading`.

    Raises
    ------
    QuadricError
        Where A is singular, or where k vanishes at the centre (a cone).
    """
    Q = _checked_4x4(Q)
    radius = np.sqrt(np.mean(np.abs(squared_semi_axes(Q)), axis=-1))
    if not np.all((radius > 0) & np.isfinite(radius)):
        raise QuadricError(f"the semi-axes are {radius} long: the quadric is a cone or a point")
    centre = -np.linalg.solve(Q[..., :3, :3], Q[..., :3, 3, None])[..., 0]
    moved = congruence(Q, scaling(1.0 / radius) @ translation(-centre))
    k = moved[..., 3, 3]
    return smallest_eigenvalue(moved / -k[..., None, None], reading)
