"""Levels of a ramp -> one vector of numbers per grasp."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features_aperture import aperture_features
from recognition.features_footprint import Footprint, PadGrid, describe_footprint
from recognition.features_growth import growth_features
from recognition.features_harmonics import harmonic_features
from recognition.features_profile import profile_features
from recognition.features_surface import surface_features
from recognition.ramp_levels import Levels

FEATURE_VERSION = 4
"""Changes with every change of a feature: models of another version are refused."""

FeatureGroups = dict[str, NDArray[np.float64]]


def feature_groups(levels: Levels, grids: Sequence[PadGrid]) -> FeatureGroups:
    """Return the features by what they tell, each (n, F) float64.

    Groups: ``patch`` (size and form of the pressed patch, unchanged when it moves or turns on the
    pad), ``pose`` (where and how it lies), ``pads`` (one pad against the other), ``growth``,
    ``profile`` (load per row and column of taxels), ``surface`` (the patch as a quadric) and
    ``aperture`` (NaN where the opening is unknown).
    """
    n = len(levels)
    prints = [
        describe_footprint(m, levels.noise[..., p], grid)
        for p, (m, grid) in enumerate(zip(levels.maps, grids, strict=True))
    ]
    patch = [_flat(part, n) for f in prints for part in _patch(f)]
    pose = [_flat(part, n) for f in prints for part in (f.direction, f.centroid_mm)]
    groups = {
        "patch": np.concatenate(patch, axis=1),
        "pose": np.concatenate(pose, axis=1),
        "growth": growth_features(levels, prints),
        "profile": _of_each_pad(profile_features, levels, grids),
        "surface": _of_each_pad(surface_features, levels, grids),
        "aperture": aperture_features(levels),
    }
    if len(prints) > 1:
        groups["pads"] = _differences(prints[0], prints[1], n)
    return groups


def close_up_features(levels: Levels, grids: Sequence[PadGrid]) -> NDArray[np.float64]:
    """Return the circular harmonics of each pad's patch, (n, F) float64; no gain changes them."""
    return _of_each_pad(harmonic_features, levels, grids)


def _of_each_pad(
    describe: Callable[[NDArray[np.float64], NDArray[np.float64], PadGrid], NDArray[np.float64]],
    levels: Levels,
    grids: Sequence[PadGrid],
) -> NDArray[np.float64]:
    parts = [describe(m, levels.noise[..., p], grids[p]) for p, m in enumerate(levels.maps)]
    return np.concatenate(parts, axis=1)


def _patch(f: Footprint) -> tuple[NDArray[np.float64], ...]:
    return (
        f.log_load,
        f.log_peak,
        f.log_extent,
        f.log_pressed,
        f.log_axes,
        f.tails,
        f.harmonics,
        f.profile,
    )


def _differences(a: Footprint, b: Footprint, n: int) -> NDArray[np.float64]:
    parts = (
        a.log_load - b.log_load,
        a.log_peak - b.log_peak,
        a.log_axes[..., 0] - b.log_axes[..., 0],
        a.centroid_mm - b.centroid_mm,
    )
    return np.concatenate([_flat(p, n) for p in parts], axis=1)


def _flat(values: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    return values.reshape(n, -1)
