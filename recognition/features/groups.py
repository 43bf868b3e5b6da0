"""Feature groups: the table of all features of a grasp, and the feature vector of each view.

A new group is one function and one entry in `FEATURE_GROUPS`. The entry lists the recognisers that
use the group. An entry that none uses, or a recogniser without a group, is an error at import; a
feature function without an entry is an error in the tests.
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
from recognition.features.patch import harmonic_features, profile_features
from recognition.ramp.levels import Levels

FEATURE_VERSION = 10
"""Changes with every change of a feature, or of what is learnt from it: models of another version
are refused."""


@unique
class FeatureView(StrEnum):
    """Recognisers that take feature vectors from the table."""

    FORCE_RAMP = "force_ramp"
    SHRINKAGE_LDA = "shrinkage_lda"
    EXTRA_TREES = "extra_trees"


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
    """One entry of the table."""

    name: str
    """Name of the group."""
    features: Callable[[GraspDescription], NDArray[np.float64]]
    """Returns the features, (n, F) float64."""
    views: frozenset[FeatureView] = frozenset(FeatureView)
    """The recognisers whose vectors contain the group."""
    n_pads: int = 1
    """Fewest gripping pads it needs; with fewer it is left out."""
    opening: bool | None = None
    """Whether it is for vectors with the opening only, or without it only; None: for both."""


FEATURE_GROUPS: tuple[FeatureGroup, ...] = (
    # Size and form of the pressed patch, unchanged when it moves or turns on the pad.
    FeatureGroup(name="patch", features=lambda of: patch_features(of.footprints)),
    # Where the patch lies on the pad, and how it is turned.
    FeatureGroup(
        name="pose",
        features=lambda of: pose_features(of.footprints),
        views=frozenset({FeatureView.FORCE_RAMP, FeatureView.SHRINKAGE_LDA}),
    ),
    # One pad against the other.
    FeatureGroup(
        name="pads",
        features=lambda of: pad_difference_features(of.footprints),
        n_pads=2,
    ),
    # Growth of patch and load along the ramp.
    FeatureGroup(name="growth", features=lambda of: growth_features(of.levels, of.footprints)),
    # Load per row and column of taxels.
    FeatureGroup(
        name="profile",
        features=lambda of: of.of_each_pad(profile_features),
        views=frozenset({FeatureView.FORCE_RAMP}),
    ),
    # The patch close up. The opening leaves too little open for it to add anything there.
    FeatureGroup(
        name="harmonics",
        features=lambda of: of.of_each_pad(harmonic_features),
        views=frozenset({FeatureView.FORCE_RAMP}),
        opening=False,
    ),
    # The opening between the fingers; NaN where it is unknown.
    FeatureGroup(name="aperture", features=lambda of: aperture_features(of.levels), opening=True),
)
"""All features of a grasp, in the order in which they stand in a vector."""


def check_table(groups: Sequence[FeatureGroup]) -> None:
    """Check the table for groups and views that were forgotten.

    Raises ValueError for a name used twice, a group that no view uses, and a view without a group.
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


check_table(FEATURE_GROUPS)


def check_version(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError for a model with features of another version; KeyError without a version."""
    version = int(arrays["feature_version"])
    if version != FEATURE_VERSION:
        raise ValueError(
            f"the model has features of version {version}, here is {FEATURE_VERSION}: train again"
        )


def features_of(
    levels: Levels, grids: Sequence[PadGrid], view: FeatureView, *, opening: bool
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
    opening
        Whether the vectors have the opening between the fingers.
    """
    described = GraspDescription(levels, grids)
    parts = [
        group.features(described)
        for group in FEATURE_GROUPS
        if view in group.views and group.n_pads <= len(grids) and group.opening in (None, opening)
    ]
    return np.concatenate(parts, axis=1)
