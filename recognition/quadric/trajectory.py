"""The training of the paper's Algorithm 1: taught quadrics are swept through poses.

Values are in the order of the printed loops (scale, translation, rotation, the last innermost).
Open points of the printed text are settings with defaults. `recognition.quadric.thresholds` names a
level by these values.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from recognition.errors import TrajectoryError
from recognition.grasp import keep_array
from recognition.quadric.eigen import Reading, smallest_eigenvalue
from recognition.quadric.quadric import by_inverse, rotation_xyz, scaling, translation


def _grid(start: float, stop: float, count: int) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.linspace(start, stop, count)
    values.setflags(write=False)
    return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweepSettings:
    """The grid of Algorithm 1 and its readings; the defaults are those of the printed text."""

    scale: NDArray[np.float64] = field(default_factory=lambda: _grid(1.0, 4.0, 31))
    """(n_scale,) float64: scale factors: 1 to 4 in steps of 0.1."""
    translation: NDArray[np.float64] = field(default_factory=lambda: _grid(-2.0, 2.0, 41))
    """(n_translation,) float64: translation along x and y in the unit of the matrices: -2 to 2 in
    steps of 0.1."""
    angle_rad: NDArray[np.float64] = field(default_factory=lambda: _grid(0.0, 2 * np.pi, 17))
    """(n_angle,) float64: rotation about x, y and z: 0 to 2 pi in steps of pi/8, both ends."""
    reading: Reading = Reading.SMALLEST_MAGNITUDE
    """Kind of the smallest eigenvalue."""

    def __post_init__(self) -> None:
        for name in ("scale", "translation", "angle_rad"):
            values = keep_array(self, name, getattr(self, name), np.float64)
            if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
                raise TrajectoryError(f"{name} must be a list of finite numbers, not {values}")

    @property
    def n_evaluations(self) -> int:
        """Matrices of one object: 21,607 for the printed grid."""
        return len(self.scale) * len(self.translation) * len(self.angle_rad)


PAPER_SWEEP = SweepSettings()
"""The grid as printed: 21,607 matrices an object."""


def sweep(D: NDArray[np.float64], settings: SweepSettings = PAPER_SWEEP) -> NDArray[np.float64]:
    """Return the smallest eigenvalues over the training loops, (n_objects, n_evaluations).

    They are in the order of the printed loops: scale outermost, rotation innermost.

    Raises TrajectoryError if ``D`` is not a list of 4x4 matrices.

    Parameters
    ----------
    D : (n_objects, 4, 4)
        Property matrices of the taught objects, symmetric.
    """
    if D.ndim != 3 or D.shape[1:] != (4, 4):
        raise TrajectoryError(f"taught quadrics have shape {D.shape}, expected (n_objects, 4, 4)")
    # M = T R S: a point is scaled first, then rotated, then translated. The printed text has one
    # loop variable for x and y, and one for all three angles.
    shift, turn = settings.translation[:, None], settings.angle_rad[:, None]
    back = translation(np.hstack([-shift, -shift, np.zeros_like(shift)]))[:, None]
    turned = np.swapaxes(rotation_xyz(np.repeat(turn, 3, axis=1)), -1, -2)
    value = np.empty((len(D), settings.n_evaluations))
    begin = 0
    for factor in settings.scale:
        M_inv = (scaling(1.0 / factor) @ turned @ back).reshape(-1, 4, 4)
        smallest = smallest_eigenvalue(by_inverse(D[:, None], M_inv), settings.reading)
        value[:, begin : begin + len(M_inv)] = smallest.value
        begin += len(M_inv)
    return value
