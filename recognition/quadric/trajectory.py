"""The paper's Algorithm 1: sweep the taught quadrics through poses, then check a level.

The values stand in the order of the printed loops (scale, translation, rotation, the last
innermost). What the printed text leaves open is a setting with a default. No matrix is formed: a
pose is reduced to what its eigenvalues depend on, each distinct one is solved once, and the value
is written wherever it belongs.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recognition.errors import TrajectoryError
from recognition.quadric.eigen import (
    Reading,
    SmallestEigenvalue,
    check_symmetric,
    smallest_eigenvalue,
)
from recognition.quadric.quadric import DEFAULT_ORDER, check_order
from recognition.quadric.sweep import (
    ArrowForm,
    arrow_form,
    groups,
    in_printed_order,
    points,
    rotates_translation,
    scales_translation,
)
from recognition.quadric.sweep_roots import smallest_of_arrow
from recognition.quadric.thresholds import check_level, find_thresholds, with_noise

_BLOCK = 8_192
"""Matrices at a time: the arrays of the solver then stay in the processor's cache."""


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
    u = in_printed_order(
        points(settings.translation, 2, separate=settings.translation_axes is Axes.SEPARATE),
        points(settings.angle_rad, 3, separate=settings.rotation_axes is Axes.SEPARATE),
        rotated=rotates_translation(settings.order),
    )
    value = np.empty((len(D), settings.n_evaluations))
    degenerate = np.empty(value.shape, dtype=np.bool_)
    for index, Q in enumerate(D):
        form = arrow_form(Q)
        features = form.features(u)
        first, group = groups(features)
        found = _over_scales(form, features[:, first], settings)
        shape = (len(settings.scale), len(u))
        np.take(found.value, group, axis=1, out=value[index].reshape(shape))
        np.take(found.degenerate, group, axis=1, out=degenerate[index].reshape(shape))
    return Trajectory(value=value, degenerate=degenerate, settings=settings)


def _over_scales(
    form: ArrowForm, features: NDArray[np.float64], settings: SweepSettings
) -> SmallestEigenvalue:
    """Return the smallest eigenvalues of all scales (rows) and features (columns)."""
    shape = (len(settings.scale), features.shape[1])
    value, degenerate = np.empty(shape), np.empty(shape, dtype=np.bool_)
    for rows, columns in blocks(*shape):
        arrow = form.arrow(
            features[:, columns],
            settings.scale[rows],
            scaled_shift=scales_translation(settings.order),
        )
        found = smallest_of_arrow(arrow, settings.reading).smallest
        value[rows, columns], degenerate[rows, columns] = found.value, found.degenerate
    return SmallestEigenvalue(value=value, degenerate=degenerate)


def blocks(n_rows: int, n_columns: int) -> Iterator[tuple[slice, slice]]:
    """Yield parts of a table that fit the cache, row by row where it is wide."""
    width = min(n_columns, _BLOCK)
    height = max(1, _BLOCK // max(width, 1))
    for column in range(0, n_columns, width):
        for row in range(0, n_rows, height):
            yield slice(row, row + height), slice(column, column + width)


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
