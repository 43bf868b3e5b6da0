"""Training set of one view of the default recogniser; feature rows of grasps under drift."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from recognition.drift.drift import DriftGrid, undo_gains
from recognition.features.aperture import undo_offsets
from recognition.features.footprint import PadGrid, pad_grid
from recognition.features.groups import Drifting, FeatureView, features_of
from recognition.features.virtual import TILTS_RAD, can_change_sides, change_sides, tilt, turn
from recognition.ramp.levels import Levels
from recognition.ramp.ramp import Rest


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureRows:
    """Features of n grasps under each drift that they may have had.

    Attributes
    ----------
    tactile : (n, G, Ft) float64
        Features of touch, each of the gains undone.
    aperture : (n, O, Fa) float64
        Features of the opening, each of the offsets undone; Fa is 0 where it is not used.
    """

    tactile: NDArray[np.float64]
    aperture: NDArray[np.float64]

    @property
    def middle(self) -> NDArray[np.float64]:
        """Features (n, Ft + Fa) with the middle gain and offset undone."""
        gain, offset = self.tactile.shape[1] // 2, self.aperture.shape[1] // 2
        return np.concatenate([self.tactile[:, gain], self.aperture[:, offset]], axis=1)

    def take(self, rows: NDArray[np.bool_]) -> Self:
        """Return some of the grasps."""
        return type(self)(tactile=self.tactile[rows], aperture=self.aperture[rows])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingSet:
    """Labelled features that one view is taught with.

    Attributes
    ----------
    features : (n, F) float64
        Finite features as they were recorded; rows of one class in the order of time.
    virtual : (n, F) float64 or None
        Features of a virtual grasp for each row.
    nuisance : (k, n, F) float64 or None
        Deviations of the features of each row in k poses that differ a little.
    rows
        The same grasps under each drift of the grid.
    classes : (n,) int64
        Class of each row.
    n_classes
        Number of classes.
    n_second
        Number of the first features that the second discriminant uses; None for no second one.
    grid
        Possible drifts.
    """

    features: NDArray[np.float64]
    virtual: NDArray[np.float64] | None
    nuisance: NDArray[np.float64] | None
    rows: FeatureRows
    classes: NDArray[np.int64]
    n_classes: int
    n_second: int | None
    grid: DriftGrid


def pad_grids(rest: Rest) -> list[PadGrid]:
    """Return the positions of the taxels of the gripping pads."""
    return [pad_grid(rest.pads, pad) for pad in rest.gripping]


def feature_view(n_classes: int, *, opening: bool) -> FeatureView:
    """Return which feature groups a view with or without the opening uses."""
    if n_classes == 1:
        return FeatureView.ONE_OBJECT_OPENING if opening else FeatureView.ONE_OBJECT_TOUCH
    return FeatureView.TOUCH_AND_OPENING if opening else FeatureView.TOUCH


def make_training_set(
    levels: Levels,
    by_gain: NDArray[np.float64],
    grids: Sequence[PadGrid],
    classes: NDArray[np.int64],
    *,
    grid: DriftGrid,
    opening: bool,
) -> TrainingSet:
    """Return the training set of a view, from grasps and their `tactile_by_gain`."""
    n_classes = int(classes.max()) + 1
    view = feature_view(n_classes, opening=opening)
    features = features_of(levels, grids, view)
    virtual = nuisance = None
    if n_classes > 1 and can_change_sides(grids):
        # The opening separates most objects already; the position of each patch then helps more
        # than virtual grasps with turned patches do.
        turned = change_sides(levels if opening else turn(levels))
        virtual = features_of(turned, grids, view)
    if opening and n_classes > 1:
        # By touch alone the direction of a patch separates some objects; here it is better ignored.
        tilted = [features_of(tilt(levels, grids, angle), grids, view) for angle in TILTS_RAD]
        nuisance = np.stack(tilted) - features
    return TrainingSet(
        features=features,
        virtual=virtual,
        rows=make_feature_rows(by_gain, levels, grids, n_classes, grid, opening=opening),
        nuisance=nuisance,
        classes=classes,
        n_classes=n_classes,
        n_second=by_gain.shape[2] if n_classes > 1 else None,
        grid=grid,
    )


def tactile_by_gain(
    levels: Levels, grids: Sequence[PadGrid], n_classes: int, grid: DriftGrid
) -> NDArray[np.float64]:
    """Return the features that a gain changes with each gain of the grid undone, (n, G, Ft)."""
    view = feature_view(n_classes, opening=False)
    features = features_of(undo_gains(levels, grid.gains), grids, view, (Drifting.GAIN,))
    return features.reshape(len(levels), len(grid.gains), -1)


def make_feature_rows(
    by_gain: NDArray[np.float64],
    levels: Levels,
    grids: Sequence[PadGrid],
    n_classes: int,
    grid: DriftGrid,
    *,
    opening: bool,
) -> FeatureRows:
    """Return the features of a view under each drift of the grid, from `tactile_by_gain`."""
    view = feature_view(n_classes, opening=opening)
    tactile = by_gain if view is not FeatureView.ONE_OBJECT_OPENING else by_gain[..., :0]
    constant = features_of(levels, grids, view, (Drifting.NOTHING,))
    if constant.shape[1]:
        alike = np.repeat(constant[:, None], by_gain.shape[1], axis=1)
        tactile = np.concatenate([tactile, alike], axis=2)
    if not opening:
        none = np.zeros((len(levels), len(grid.offsets_mm), 0))
        return FeatureRows(tactile=tactile, aperture=none)
    aperture = features_of(levels, grids, view, (Drifting.OFFSET,))
    return FeatureRows(tactile=tactile, aperture=undo_offsets(aperture, grid.offsets_mm))
