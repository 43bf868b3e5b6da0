"""Comparators of the paper's references and present ones: features and classifier of each.

Each is a `Comparator` subclass with its `Method`, and one entry in `recognition.recognizers`.
Only `ShrinkageLda` and `ExtraTrees` use the opening.
"""

import numpy as np
from numpy.typing import NDArray

from recognition.features.footprint import PadGrid
from recognition.features.groups import FeatureView
from recognition.recognizers.comparators.classifiers import (
    Forest,
    Linear,
    NearestNeighbour,
    Network,
)
from recognition.recognizers.comparators.comparator import Comparator, Method
from recognition.recognizers.comparators.invariants import section_features
from recognition.recognizers.comparators.outline import (
    angles_and_lengths,
    canonical_start,
    centroid_mm,
    outline_radii_mm,
    polygon,
    sample_mm,
)

_ANGLES = 32
"""Number of directions of the outline and of its radius vectors."""
_VERTICES = 8
"""Vertices of the outline's polygon."""


def polygon_features(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return turning angles and edge lengths of the outline's polygon, in their order."""
    return angles_and_lengths(polygon(outline_radii_mm(patch, grid, _ANGLES), _VERTICES))


class ContourNetwork(Comparator):
    """Angles and lengths of the outline's polygon, and a neural network, after Ng.

    The comparator of the paper's refs. [7, 8]: the outline becomes a polygon of eight edges;
    turning angles and edge lengths do not change with its position, rotation and size. It is
    planar, and needs the whole outline.
    """

    __slots__ = ()
    method = Method(name="contour_network", features=polygon_features, classifier=Network)


class ShrinkageLda(Comparator):
    """Plain reference: one shrunken discriminant, one temperature, one distance."""

    __slots__ = ()
    method = Method(
        name="shrinkage_lda",
        features=FeatureView.SHRINKAGE_LDA,
        classifier=Linear,
    )


class ExtraTrees(Comparator):
    """Extremely randomised trees on moments of the patches: a plain present method.

    The features are size, extent, moments and harmonics of both patches along the ramp, their
    differences and growth, and optionally the opening.
    """

    __slots__ = ()
    method = Method(
        name="extra_trees",
        features=FeatureView.EXTRA_TREES,
        classifier=Forest,
    )


def radius_vector_features(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return the distances of the outline from its centroid, over their mean."""
    radii_mm = outline_radii_mm(patch, grid, _ANGLES)
    return canonical_start(radii_mm / radii_mm.mean())


class RadiusVector(Comparator):
    """Radius vector of the outline, and a neural network.

    The comparator of the paper's refs. [6, 7, 12]. It first normalises position, size and rotation
    of the outline: distances are from the centroid, over their mean, and begin at the long axis. It
    is planar, so it cannot distinguish two objects with one outline.
    """

    __slots__ = ()
    method = Method(name="radius_vector", features=radius_vector_features, classifier=Network)


def centred_pressures(patch: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return the pressures of a pad, shifted so that the centre of the load is in its middle."""
    middle_mm = grid.xy_mm.mean(axis=0)
    return sample_mm(patch, grid, grid.xy_mm + centroid_mm(patch, grid) - middle_mm)


class RawNeighbours(Comparator):
    """Nearest neighbour on raw pads: the taught grasp with the most similar pressures."""

    __slots__ = ()
    method = Method(
        name="raw_neighbours",
        features=centred_pressures,
        classifier=NearestNeighbour,
        standardise=False,
    )


class ContactInvariants(Comparator):
    """Differential invariants of the pressed surface, after Ibrayev and Jia.

    The comparator of the paper's refs. [3, 4]: curvature and its derivative at up to three points
    of a cubic curve give numbers that do not change in a rigid motion. The curves are the principal
    sections of the patch. A linear discriminant decides, because the source names no classifier.
    """

    __slots__ = ()
    method = Method(name="contact_invariants", features=section_features, classifier=Linear)
