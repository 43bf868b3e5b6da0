"""Angles and lengths of the outline's polygon, and a neural network, after Ng.

The comparator of the paper's refs. [7, 8]: the outline becomes a polygon of eight edges; turning
angles and edge lengths in their order tell it, whatever its position, rotation and size. It is
planar, and needs the whole sequence.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid
from recognition.outline import angles_and_lengths, outline_radii_mm, polygon
from recognition.ramp_levels import Levels
from recognition.recognizers._classifiers import Network
from recognition.recognizers._comparator import (
    Comparator,
    ComparatorTrainer,
    Method,
    full_load_features,
)

_ANGLES = 32
_VERTICES = 8


def _one_pad(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    return angles_and_lengths(polygon(outline_radii_mm(patch, grid, _ANGLES), _VERTICES))


def _features(levels: Levels, grids: Sequence[PadGrid], use_aperture: bool) -> NDArray[np.float64]:
    del use_aperture
    return full_load_features(levels, grids, _one_pad)


class ContourNetwork(Comparator):
    """Classifies sequences of angles and lengths."""

    __slots__ = ()
    method = Method(name="contour_network", describe=_features, classifier=Network)


def contour_network_trainer(use_aperture: bool) -> ComparatorTrainer:
    """Return the trainer; the method has no place for the opening."""
    return ComparatorTrainer(kind=ContourNetwork, use_aperture=use_aperture)
