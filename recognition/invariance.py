"""How far the smallest eigenvalue keeps under each transformation of the paper's grid.

The paper claims that it is independent of rotation, translation and scale (eq. (8) to (10), Fig.
3). Here each kind is applied alone, and all together, and the matrices are formed and solved in
full: nothing of what the fast sweep knows beforehand is used.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from recognition.eigen import Reading, check_symmetric, smallest_eigenvalue
from recognition.errors import TrajectoryError
from recognition.sweep_grid import points
from recognition.trajectory import PAPER_SWEEP, Axes, SweepSettings
from recognition.transform import by_inverse, rotation_xyz, scaling, translation

_STILL = replace(PAPER_SWEEP, scale=np.ones(1), translation=np.zeros(1), angle_rad=np.zeros(1))

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
