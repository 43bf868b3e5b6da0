"""The paper's Algorithm 1: sweep the taught quadrics through poses, then check a level.

The three loops are run as printed (scale, translation, rotation, the last innermost), in arrays
instead of one matrix at a time. What the printed text leaves open is a setting with a default.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.eigen import (
    Reading,
    SmallestEigenvalue,
    ascending,
    check_symmetric,
    smallest_eigenvalue,
    smallest_of,
)
from recognition.errors import TrajectoryError
from recognition.thresholds import check_level, find_thresholds
from recognition.transform import (
    DEFAULT_ORDER,
    check_order,
    rotation_xyz,
    scaling,
    translation,
)

_BLOCK = 65_536  # matrices in memory at a time


class Axes(StrEnum):
    """How one loop variable stands for several axes."""

    EQUAL = "equal"
    """All axes take the same value, as the single loop variable of the printed text says."""
    SEPARATE = "separate"
    """Each axis has a loop of its own."""


def _grid(start: float, stop: float, count: int) -> NDArray[np.float64]:
    values: NDArray[np.float64] = np.linspace(start, stop, count)
    values.setflags(write=False)
    return values


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SweepSettings:
    """The grid of Algorithm 1 and its readings; the defaults are those of the printed text.

    Attributes
    ----------
    scale : (n_scale,) float64
        Scale factors: 1 to 4 in steps of 0.1.
    translation : (n_translation,) float64
        Translation along x and y in the unit of the matrices: -2 to 2 in steps of 0.1.
    angle_rad : (n_angle,) float64
        Rotation about x, y and z: 0 to 2 pi in steps of pi/8, both ends.
    translation_axes, rotation_axes
        Whether x and y, and the three angles, run together or in loops of their own.
    order
        Product that maps points: "TRS" is M = T R S. With rotation last ("RTS") it changes no
        eigenvalue.
    reading
        Which eigenvalue is followed.
    max_evaluations
        Largest number of matrices of one object that is accepted.
    """

    scale: NDArray[np.float64] = field(default_factory=lambda: _grid(1.0, 4.0, 31))
    translation: NDArray[np.float64] = field(default_factory=lambda: _grid(-2.0, 2.0, 41))
    angle_rad: NDArray[np.float64] = field(default_factory=lambda: _grid(0.0, 2 * np.pi, 17))
    translation_axes: Axes = Axes.EQUAL
    rotation_axes: Axes = Axes.EQUAL
    order: str = DEFAULT_ORDER
    reading: Reading = Reading.SMALLEST_MAGNITUDE
    max_evaluations: int = 2_000_000

    def __post_init__(self) -> None:
        check_order(self.order)
        for name in ("scale", "translation", "angle_rad"):
            values = np.array(getattr(self, name), dtype=np.float64)
            if values.ndim != 1 or not len(values) or not np.all(np.isfinite(values)):
                raise TrajectoryError(f"{name} must be a list of finite numbers, not {values}")
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        if self.n_evaluations > self.max_evaluations:
            raise TrajectoryError(
                f"the grid has {self.n_evaluations:,} points an object, limit "
                f"{self.max_evaluations:,}; use equal axes, or raise max_evaluations"
            )

    @property
    def n_evaluations(self) -> int:
        """Matrices of one object: 21,607 for the printed grid."""
        n_shift = len(self.translation) ** (2 if self.translation_axes is Axes.SEPARATE else 1)
        n_turn = len(self.angle_rad) ** (3 if self.rotation_axes is Axes.SEPARATE else 1)
        return len(self.scale) * n_shift * n_turn


PAPER_SWEEP = SweepSettings()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Smallest eigenvalues of the taught objects over the grid.

    Attributes
    ----------
    value : (n_objects, n_evaluations) float64
        In the order of the printed loops: scale outermost, rotation innermost. Read-only.
    degenerate : (n_objects, n_evaluations) bool
        True where a value is rounding noise. Read-only.
    settings
        The grid.
    """

    value: NDArray[np.float64]
    degenerate: NDArray[np.bool_]
    settings: SweepSettings

    def __post_init__(self) -> None:
        self.value.setflags(write=False)
        self.degenerate.setflags(write=False)

    @property
    def spread(self) -> NDArray[np.float64]:
        """Least and largest value of each object, (n_objects, 2): how invariant the feature is."""
        return np.stack([self.value.min(axis=1), self.value.max(axis=1)], axis=1)


def _points(values: NDArray[np.float64], axes: Axes, n_axes: int) -> NDArray[np.float64]:
    """Return the loop's points, (n, n_axes)."""
    if axes is Axes.SEPARATE:
        return np.array(list(product(values, repeat=n_axes)))
    return np.repeat(values[:, None], n_axes, axis=1)


def _blocks(settings: SweepSettings) -> Iterator[dict[str, NDArray[np.float64]]]:
    """Yield M^-1's factors, inverted analytically, for blocks of the grid in printed order."""
    shift = _points(settings.translation, settings.translation_axes, 2)
    shift = np.concatenate([shift, np.zeros((len(shift), 1))], axis=1)
    T = translation(-shift)[:, None]
    R = np.swapaxes(rotation_xyz(_points(settings.angle_rad, settings.rotation_axes, 3)), -1, -2)
    step = max(1, _BLOCK // len(R))
    for S in scaling(1.0 / settings.scale):
        for start in range(0, len(T), step):
            yield {"S": S, "T": T[start : start + step], "R": R}


def sweep(D: ArrayLike, settings: SweepSettings = PAPER_SWEEP) -> Trajectory:
    """Run the training loops of Algorithm 1.

    Parameters
    ----------
    D : (n_objects, 4, 4)
        Property matrices of the taught objects.
    settings
        Grid and readings.

    Raises
    ------
    QuadricError
        Where a matrix is not symmetric or not finite.
    TrajectoryError
        Where ``D`` is not a list of 4x4 matrices.
    """
    D = check_symmetric(D)
    if D.ndim != 3 or D.shape[1:] != (4, 4):
        raise TrajectoryError(f"taught quadrics have shape {D.shape}, expected (n_objects, 4, 4)")
    value = np.empty((len(D), settings.n_evaluations))
    degenerate = np.empty(value.shape, dtype=np.bool_)
    for index, Q in enumerate(D):
        start = 0
        for inverse in _blocks(settings):
            found = _smallest_after(Q, inverse, settings)
            stop = start + found.value.size
            value[index, start:stop] = found.value.ravel()
            degenerate[index, start:stop] = found.degenerate.ravel()
            start = stop
    return Trajectory(value=value, degenerate=degenerate, settings=settings)


def _smallest_after(
    Q: NDArray[np.float64], inverse: dict[str, NDArray[np.float64]], settings: SweepSettings
) -> SmallestEigenvalue:
    """Carry one quadric through a block and take its smallest eigenvalues."""
    for letter in reversed(settings.order):
        M_inv = inverse[letter]
        Q = np.swapaxes(M_inv, -1, -2) @ Q @ M_inv
    return smallest_of(ascending(Q), settings.reading)


def contact_classify(
    D: ArrayLike,
    unknown: ArrayLike,
    settings: SweepSettings = PAPER_SWEEP,
) -> int | None:
    """Run Algorithm 1, Contact-Classify: name the taught object that a matrix belongs to.

    Parameters
    ----------
    D : (n_objects, 4, 4)
        Property matrices of the taught objects.
    unknown : (4, 4)
        Property matrix of the object to be named (I in the paper).
    settings
        Grid and readings.

    Returns
    -------
    int or None
        Index into ``D``; None for unknown: outside every band, in a closed window, or where the
        eigenvalue of ``unknown`` is rounding noise.
    """
    trajectory = sweep(D, settings)
    usable = np.where(trajectory.degenerate, np.nan, trajectory.value)
    levels = find_thresholds(list(usable))
    smallest = smallest_eigenvalue(unknown, settings.reading)
    if smallest.degenerate:
        return None
    return check_level(levels, float(smallest.value))
