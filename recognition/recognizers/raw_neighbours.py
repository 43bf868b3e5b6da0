"""Nearest neighbour on raw pads: the taught grasp whose pressures are most alike.

The pads at full load, shifted so that the load's centre lies in the middle of the pad; nothing
else is taken out.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid
from recognition.outline import centroid_mm, sample_mm
from recognition.ramp_levels import Levels
from recognition.recognizers._classifiers import NearestNeighbour
from recognition.recognizers._comparator import (
    Comparator,
    ComparatorTrainer,
    Method,
    full_load_features,
)


def _one_pad(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    middle_mm = grid.xy_mm.mean(axis=0)
    return sample_mm(patch, grid, grid.xy_mm + centroid_mm(patch, grid) - middle_mm)


def _features(levels: Levels, grids: Sequence[PadGrid], use_aperture: bool) -> NDArray[np.float64]:
    del use_aperture
    return full_load_features(levels, grids, _one_pad)


class RawNeighbours(Comparator):
    """Finds the nearest taught grasp."""

    __slots__ = ()
    method = Method(
        name="raw_neighbours", describe=_features, classifier=NearestNeighbour, standardise=False
    )


def raw_neighbours_trainer(use_aperture: bool) -> ComparatorTrainer:
    """Return the trainer; the method has no place for the opening."""
    return ComparatorTrainer(kind=RawNeighbours, use_aperture=use_aperture)
