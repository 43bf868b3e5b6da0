"""The paper's Algorithm 1: sweep the taught quadrics through poses, then check a level.

The values stand in the order of the printed loops (scale, translation, rotation, the last
innermost). What the printed text leaves open is a setting with a default.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import TrajectoryError
from recognition.quadric.eigen import (
    Reading,
    ascending,
    check_symmetric,
    smallest_eigenvalue,
    smallest_of,
)
from recognition.quadric.quadric import (
    DEFAULT_ORDER,
    by_inverse,
    check_order,
    compose,
    rotation_xyz,
    scaling,
    translation,
)
from recognition.quadric.thresholds import check_level, find_thresholds, with_noise


class Axes(StrEnum):
    """How one loop variable stands for several axes."""

    EQUAL = "equal"
    """All axes take the same value, as with the single loop variable of the printed text."""
    SEPARATE = "separate"
    """Each axis has a loop of its own."""


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
    translation_axes: Axes = Axes.EQUAL
    rotation_axes: Axes = Axes.EQUAL
    """Whether x and y, and the three angles, run together or in loops of their own."""
    order: str = DEFAULT_ORDER
    """Product that maps points: "TRS" is M = T R S. With rotation last ("RTS") it changes no
    eigenvalue."""
    reading: Reading = Reading.SMALLEST_MAGNITUDE
    """Which eigenvalue is followed."""
    max_evaluations: int = 2_000_000
    """Largest number of matrices of one object that is accepted."""

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
"""The grid as printed: 21,607 matrices an object."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """Smallest eigenvalues of the taught objects over the grid."""

    value: NDArray[np.float64]
    """(n_objects, n_evaluations) float64: in the order of the printed loops: scale outermost,
    rotation innermost. Read-only."""
    degenerate: NDArray[np.bool_]
    """(n_objects, n_evaluations) bool: true where a value is rounding noise. Read-only."""
    settings: SweepSettings
    """The grid."""

    def __post_init__(self) -> None:
        self.value.setflags(write=False)
        self.degenerate.setflags(write=False)

    @property
    def spread(self) -> NDArray[np.float64]:
        """Least and largest value of each object, (n_objects, 2): how invariant the feature is."""
        return np.stack([self.value.min(axis=1), self.value.max(axis=1)], axis=1)


def sweep(D: ArrayLike, settings: SweepSettings = PAPER_SWEEP) -> Trajectory:
    """Return the smallest eigenvalues over the training loops of Algorithm 1.

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
    begin = 0
    for M_inv in inverse_poses(settings):
        part = np.s_[:, begin : begin + len(M_inv)]
        found = smallest_of(ascending(by_inverse(D[:, None], M_inv)), settings.reading)
        value[part], degenerate[part] = found.value, found.degenerate
        begin += len(M_inv)
    return Trajectory(value=value, degenerate=degenerate, settings=settings)


def inverse_poses(settings: SweepSettings) -> Iterator[NDArray[np.float64]]:
    """Yield M^-1 of all poses of each scale, (n, 4, 4), in the order of the printed loops."""
    shift = _points(settings.translation, 2, settings.translation_axes)
    turn = _points(settings.angle_rad, 3, settings.rotation_axes)
    back = translation(np.column_stack([-shift, np.zeros(len(shift))]))[:, None]
    turned = np.swapaxes(rotation_xyz(turn), -1, -2)
    for factor in settings.scale:
        yield compose(
            translate=back,
            rotate=turned,
            scale=scaling(1.0 / factor),
            order=settings.order[::-1],
        ).reshape(-1, 4, 4)


def _points(values: NDArray[np.float64], n_axes: int, axes: Axes) -> NDArray[np.float64]:
    """Return a loop's points, (n, n_axes): its value on all axes, or a loop for each axis."""
    if axes is Axes.SEPARATE:
        return np.array(list(product(values, repeat=n_axes)))
    return np.repeat(values[:, None], n_axes, axis=1)


def contact_classify(
    D: ArrayLike,
    unknown: ArrayLike,
    settings: SweepSettings = PAPER_SWEEP,
    *,
    noise_share: float = 0.0,
) -> int | None:
    """Return the taught object of a matrix by Algorithm 1, Contact-Classify.

    Parameters
    ----------
    D : (n_objects, 4, 4)
        Property matrices of the taught objects.
    unknown : (4, 4)
        Property matrix of the object to be named (I in the paper).
    settings
        Grid and readings.
    noise_share
        Part of its value by which the level of ``unknown`` is uncertain, which widens the bands
        and narrows the windows (`recognition.quadric.thresholds.with_noise`).

    Returns
    -------
    int or None
        Index into ``D``; None for unknown: outside every band, in a closed window, or where the
        eigenvalue of ``unknown`` is rounding noise.
    """
    trajectory = sweep(D, settings)
    usable = np.where(trajectory.degenerate, np.nan, trajectory.value)
    levels = with_noise(find_thresholds(list(usable)), noise_share)
    smallest = smallest_eigenvalue(unknown, settings.reading)
    if smallest.degenerate:
        return None
    return check_level(levels, float(smallest.value))
