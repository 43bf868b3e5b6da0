"""Feature groups: the table of all features by touch, and the feature vector of the recognizers.

A new group is one function and one entry in `FEATURE_GROUPS`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.features.aperture import aperture_features
from recognition.features.footprint import (
    Footprint,
    PadGrid,
    describe_footprint,
    growth_features,
    harmonic_features,
    pad_difference_features,
    pad_grid,
    patch_features,
    pose_features,
    profile_features,
)
from recognition.ramp.levels import Levels
from recognition.ramp.ramp import Rest

FEATURE_VERSION = 13
"""Version of the features and of their use in a model. Models of another version are refused."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FeatureGroup:
    """One entry of the table."""

    name: str
    """Name of the group."""
    features: Callable[[Levels, Sequence[Footprint]], NDArray[np.float64]]
    """Returns the features (n, F) float64 of n grasps, from their levels and the footprint of each
    gripping pad."""
    with_opening: bool = True
    """Whether vectors with the opening contain it, too."""


FEATURE_GROUPS: tuple[FeatureGroup, ...] = (
    # Size and form of the pressed patch, unchanged when it moves or turns on the pad.
    FeatureGroup(name="patch", features=lambda _, pads: patch_features(pads)),
    # Position of the patch on the pad, and its rotation.
    FeatureGroup(name="pose", features=lambda _, pads: pose_features(pads)),
    # One pad against the other.
    FeatureGroup(name="pads", features=lambda _, pads: pad_difference_features(pads)),
    # Growth of patch and load along the ramp.
    FeatureGroup(name="growth", features=growth_features),
    # Load per row and column of taxels.
    FeatureGroup(name="profile", features=lambda _, pads: profile_features(pads)),
    # Details of the patch. With the opening they add nothing.
    FeatureGroup(
        name="harmonics",
        features=lambda _, pads: harmonic_features(pads),
        with_opening=False,
    ),
)
"""All features by touch, in their order in a vector."""


def touch_features(
    levels: Levels, grids: Sequence[PadGrid], *, opening: bool
) -> NDArray[np.float64]:
    """Return the features by touch, (n, F) float64.

    ``opening`` is whether the vector also has features of the opening.
    """
    footprints = [
        describe_footprint(maps, levels.noise[..., pad], grid)
        for pad, (maps, grid) in enumerate(zip(levels.maps, grids, strict=True))
    ]
    return np.concatenate(
        [
            group.features(levels, footprints)
            for group in FEATURE_GROUPS
            if group.with_opening or not opening
        ],
        axis=1,
    )


def features_of(levels: Levels, rest: Rest, *, opening: bool) -> NDArray[np.float64]:
    """Return `touch_features`; with ``opening`` those of the opening follow, NaN if unknown."""
    grids = [pad_grid(rest.pads, pad) for pad in rest.gripping]
    touch = touch_features(levels, grids, opening=opening)
    return np.concatenate([touch, aperture_features(levels)], axis=1) if opening else touch
