"""From the force levels of grasps to what the views of the default recogniser look at."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.drift import DriftGrid, undo_gains
from recognition.features import close_up_features, feature_groups
from recognition.features_aperture import aperture_features, undo_offsets
from recognition.features_footprint import PadGrid, pad_grid
from recognition.ramp import Rest
from recognition.ramp_levels import Levels
from recognition.recognizers._telling import Rows
from recognition.recognizers._view import Lesson
from recognition.virtual import TILTS_RAD, can_change_sides, change_sides, tilt, turn

_TACTILE_GROUPS = ("patch", "pose", "pads", "growth", "profile", "surface")
_SINGLE_GROUPS = ("surface",)
"""With one object nothing says which features separate: few and plain ones do best."""


def pad_grids(rest: Rest) -> list[PadGrid]:
    """Return where the taxels of the gripping pads are."""
    return [pad_grid(rest.pads, pad) for pad in rest.gripping]


def make_lesson(
    levels: Levels,
    undone: NDArray[np.float64],
    grids: Sequence[PadGrid],
    classes: NDArray[np.int64],
    *,
    grid: DriftGrid,
    opening: bool,
) -> Lesson:
    """Return what a view is taught with, of grasps and their touch with each gain undone."""
    n_classes = int(classes.max()) + 1
    features = _features(levels, grids, n_classes, opening=opening)
    virtual = nuisance = None
    if n_classes > 1 and can_change_sides(grids):
        # The opening tells the objects apart already; where each patch lies then helps more than
        # patches that are turned hurt.
        turned = change_sides(levels if opening else turn(levels))
        virtual = _features(turned, grids, n_classes, opening=opening)
    both = opening and n_classes > 1
    if both:
        # By touch alone how a patch lies tells some objects apart; here it is better ignored.
        tilted = [
            _features(tilt(levels, grids, a), grids, n_classes, opening=True) for a in TILTS_RAD
        ]
        nuisance = np.stack(tilted) - features
    return Lesson(
        features=features,
        virtual=virtual,
        rows=make_rows(undone, levels, grids, n_classes, grid, opening=opening),
        nuisance=nuisance,
        classes=classes,
        n_classes=n_classes,
        n_second=undone.shape[2] if n_classes > 1 else None,
        grid=grid,
    )


def _features(
    levels: Levels, grids: Sequence[PadGrid], n_classes: int, *, opening: bool
) -> NDArray[np.float64]:
    """Return the features of a view, (n, F); of one object, touch or the opening alone."""
    if not opening:
        tactile = _tactile(levels, grids, n_classes)
        if n_classes == 1:
            return tactile
        return np.concatenate([tactile, close_up_features(levels, grids)], axis=1)
    aperture = aperture_features(levels)
    if n_classes == 1:
        return aperture
    return np.concatenate([_tactile(levels, grids, n_classes), aperture], axis=1)


def undone_gains(
    levels: Levels, grids: Sequence[PadGrid], n_classes: int, grid: DriftGrid
) -> NDArray[np.float64]:
    """Return the features of touch with each gain of the grid undone, (n, G, Ft)."""
    tactile = _tactile(undo_gains(levels, grid.gains), grids, n_classes)
    return tactile.reshape(len(levels), len(grid.gains), -1)


def make_rows(
    undone: NDArray[np.float64],
    levels: Levels,
    grids: Sequence[PadGrid],
    n_classes: int,
    grid: DriftGrid,
    *,
    opening: bool,
) -> Rows:
    """Return the features of a view under each drift of the grid; see `undone_gains`."""
    if not opening:
        none = np.zeros((len(levels), len(grid.offsets_mm), 0))
        if n_classes > 1:
            # The opening leaves too little open for the patch close up to add anything there.
            close_up = close_up_features(levels, grids)[:, None]
            alike = np.repeat(close_up, undone.shape[1], axis=1)
            undone = np.concatenate([undone, alike], axis=2)
        return Rows(tactile=undone, aperture=none)
    aperture = undo_offsets(aperture_features(levels), grid.offsets_mm)
    return Rows(tactile=undone[..., :0] if n_classes == 1 else undone, aperture=aperture)


def _tactile(levels: Levels, grids: Sequence[PadGrid], n_classes: int) -> NDArray[np.float64]:
    groups = feature_groups(levels, grids)
    wanted = _TACTILE_GROUPS if n_classes > 1 else _SINGLE_GROUPS
    return np.concatenate([groups[name] for name in wanted if name in groups], axis=1)
