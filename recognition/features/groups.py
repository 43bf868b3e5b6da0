"""Feature groups: the table of all features of a grasp, and the feature vector of each view.

A new group is one function and one entry in `FEATURE_GROUPS`. The entry lists the views that use
the group and whether a drift of the sensors changes it. An entry that no view uses, or a view
without a group, is an error at import; a feature function without an entry is an error in the
tests.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum, unique
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.features.aperture import aperture_features
from recognition.features.footprint import (
    Footprint,
    PadGrid,
    describe_footprint,
    pad_difference_features,
    patch_features,
    pose_features,
)
from recognition.features.growth import growth_features
from recognition.features.patch import harmonic_features, profile_features, surface_features
from recognition.ramp.levels import Levels

FEATURE_VERSION = 4
"""Changes with every change of a feature: models of another version are refused."""


@unique
class FeatureView(StrEnum):
    """Users of feature vectors: one way of one recogniser to describe a grasp."""

    TOUCH = "touch"
    """`force_ramp` by touch alone."""
    TOUCH_AND_OPENING = "touch_and_opening"
    """`force_ramp` by touch and opening."""
    ONE_OBJECT_TOUCH = "one_object_touch"
    """`force_ramp` with a single object, by touch alone. No other object shows which features
    separate: few and plain ones do best."""
    ONE_OBJECT_OPENING = "one_object_opening"
    """`force_ramp` with a single object, by the opening."""
    SHRINKAGE_LDA = "shrinkage_lda"
    EXTRA_TREES = "extra_trees"


@unique
class Drifting(StrEnum):
    """What of a drift of the sensors changes a feature group."""

    GAIN = "gain"
    """The gain of the pads."""
    OFFSET = "offset"
    """The zero of the opening."""
    NOTHING = "nothing"


class GraspDescription:
    """Levels of n grasps with the footprints of their pads, which several groups share.

    Parameters
    ----------
    levels
        The grasps.
    grids
        The gripping pads.
    """

    def __init__(self, levels: Levels, grids: Sequence[PadGrid]) -> None:
        self.levels = levels
        self.grids = grids

    @cached_property
    def footprints(self) -> list[Footprint]:
        """The footprint of each gripping pad."""
        return [
            describe_footprint(maps, self.levels.noise[..., pad], grid)
            for pad, (maps, grid) in enumerate(zip(self.levels.maps, self.grids, strict=True))
        ]

    def of_each_pad(
        self,
        describe: Callable[
            [NDArray[np.float64], NDArray[np.float64], PadGrid], NDArray[np.float64]
        ],
    ) -> NDArray[np.float64]:
        """Return features (n, F) of each pad, one pad after the other."""
        levels = self.levels
        parts = [
            describe(maps, levels.noise[..., pad], self.grids[pad])
            for pad, maps in enumerate(levels.maps)
        ]
        return np.concatenate(parts, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureGroup:
    """One entry of the table.

    Attributes
    ----------
    name
        Name of the group.
    features
        Returns the features, (n, F) float64.
    views
        The views whose vectors contain the group.
    drifting
        What of a drift changes it.
    n_pads
        Fewest gripping pads it needs; with fewer it is left out.
    """

    name: str
    features: Callable[[GraspDescription], NDArray[np.float64]]
    views: frozenset[FeatureView]
    drifting: Drifting = Drifting.GAIN
    n_pads: int = 1


_ALL_TOUCH = frozenset(
    {
        FeatureView.TOUCH,
        FeatureView.TOUCH_AND_OPENING,
        FeatureView.SHRINKAGE_LDA,
        FeatureView.EXTRA_TREES,
    }
)

FEATURE_GROUPS: tuple[FeatureGroup, ...] = (
    # Size and form of the pressed patch, unchanged when it moves or turns on the pad.
    FeatureGroup(name="patch", features=lambda of: patch_features(of.footprints), views=_ALL_TOUCH),
    # Where the patch lies on the pad, and how it is turned.
    FeatureGroup(
        name="pose",
        features=lambda of: pose_features(of.footprints),
        views=_ALL_TOUCH - {FeatureView.EXTRA_TREES},
    ),
    # One pad against the other.
    FeatureGroup(
        name="pads",
        features=lambda of: pad_difference_features(of.footprints),
        views=_ALL_TOUCH,
        n_pads=2,
    ),
    # Growth of patch and load along the ramp.
    FeatureGroup(
        name="growth",
        features=lambda of: growth_features(of.levels, of.footprints),
        views=_ALL_TOUCH,
    ),
    # Load per row and column of taxels.
    FeatureGroup(
        name="profile",
        features=lambda of: of.of_each_pad(profile_features),
        views=frozenset({FeatureView.TOUCH, FeatureView.TOUCH_AND_OPENING}),
    ),
    # The patch as a quadric surface.
    FeatureGroup(
        name="surface",
        features=lambda of: of.of_each_pad(surface_features),
        views=frozenset(
            {FeatureView.TOUCH, FeatureView.TOUCH_AND_OPENING, FeatureView.ONE_OBJECT_TOUCH}
        ),
    ),
    # The patch close up. The opening leaves too little open for it to add anything there.
    FeatureGroup(
        name="harmonics",
        features=lambda of: of.of_each_pad(harmonic_features),
        views=frozenset({FeatureView.TOUCH}),
        drifting=Drifting.NOTHING,
    ),
    # The opening between the fingers; NaN where it is unknown.
    FeatureGroup(
        name="aperture",
        features=lambda of: aperture_features(of.levels),
        views=frozenset(
            {
                FeatureView.TOUCH_AND_OPENING,
                FeatureView.ONE_OBJECT_OPENING,
                FeatureView.SHRINKAGE_LDA,
                FeatureView.EXTRA_TREES,
            }
        ),
        drifting=Drifting.OFFSET,
    ),
)
"""All features of a grasp, in the order in which they stand in a vector."""


def check_table(groups: Sequence[FeatureGroup]) -> None:
    """Check the table for groups and views that were forgotten.

    Raises ValueError for a name used twice, a group that no view uses, a view without a group, and
    for views of touch that would not agree on what a gain changes: both are taught with one array.
    """
    names = [group.name for group in groups]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ValueError(f"feature groups {twice} are in the table twice: give each its own name")
    unused = [group.name for group in groups if not group.views]
    if unused:
        raise ValueError(f"feature groups {unused} are used by no view: name at least one")
    empty = [str(view) for view in FeatureView if not any(view in group.views for group in groups)]
    if empty:
        raise ValueError(f"views {empty} use no feature group: name them in the table's entries")
    both = {FeatureView.TOUCH, FeatureView.TOUCH_AND_OPENING}
    one_only = [
        group.name
        for group in groups
        if group.drifting is Drifting.GAIN and len(both & group.views) == 1
    ]
    if one_only:
        raise ValueError(f"feature groups {one_only} change with the gain: use them in both {both}")


check_table(FEATURE_GROUPS)


def check_version(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError for a model with features of another version; KeyError without a version."""
    version = int(arrays["feature_version"])
    if version != FEATURE_VERSION:
        raise ValueError(
            f"the model has features of version {version}, here is {FEATURE_VERSION}: train again"
        )


def features_of(
    levels: Levels,
    grids: Sequence[PadGrid],
    view: FeatureView,
    drifting: Sequence[Drifting] = tuple(Drifting),
) -> NDArray[np.float64]:
    """Return the feature vectors of a view, (n, F) float64.

    Parameters
    ----------
    levels
        The n grasps.
    grids
        The gripping pads.
    view
        Which groups are wanted.
    drifting
        Only groups that these parts of a drift change; F is 0 where there are none.
    """
    described = GraspDescription(levels, grids)
    parts = [
        group.features(described)
        for group in FEATURE_GROUPS
        if view in group.views and group.drifting in drifting and group.n_pads <= len(grids)
    ]
    return np.concatenate([np.zeros((len(levels), 0)), *parts], axis=1)
