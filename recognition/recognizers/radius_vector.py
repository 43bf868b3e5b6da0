"""Radius vector and neural network: the outline of the patch as distances from its centre.

The comparator of the paper's refs. [6, 7, 12]. The outline needs a fixed position, size and
rotation first: distances count from the centroid, in parts of their mean, from the long axis on.
It is planar: two objects with one outline are one object to it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid
from recognition.outline import canonical_start, outline_radii_mm
from recognition.ramp_levels import Levels
from recognition.recognizers._classifiers import Network
from recognition.recognizers._comparator import (
    Comparator,
    ComparatorTrainer,
    Method,
    full_load_features,
)

_ANGLES = 32


def _one_pad(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    radii_mm = outline_radii_mm(patch, grid, _ANGLES)
    return canonical_start(radii_mm / radii_mm.mean())


def _features(levels: Levels, grids: Sequence[PadGrid], use_aperture: bool) -> NDArray[np.float64]:
    del use_aperture
    return full_load_features(levels, grids, _one_pad)


class RadiusVector(Comparator):
    """Classifies radius vectors."""

    __slots__ = ()
    method = Method(name="radius_vector", describe=_features, classifier=Network)


def radius_vector_trainer(use_aperture: bool) -> ComparatorTrainer:
    """Return the trainer; the method has no place for the opening."""
    return ComparatorTrainer(kind=RadiusVector, use_aperture=use_aperture)
