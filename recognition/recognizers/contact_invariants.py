"""Differential invariants of the pressed surface at few points, after Ibrayev and Jia.

The comparator of the paper's refs. [3, 4]: curvature and its derivative at up to three points of
a quadratic or cubic curve make numbers that no rigid motion changes. The curves are the principal
sections of the patch; a linear discriminant decides, as the source leaves that open.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid
from recognition.ramp_levels import Levels
from recognition.recognizers._classifiers import Linear
from recognition.recognizers._comparator import (
    Comparator,
    ComparatorTrainer,
    Method,
    full_load_features,
)
from recognition.section_invariants import section_features


def _features(levels: Levels, grids: Sequence[PadGrid], use_aperture: bool) -> NDArray[np.float64]:
    del use_aperture
    return full_load_features(levels, grids, section_features)


class ContactInvariants(Comparator):
    """Classifies invariants of the principal sections."""

    __slots__ = ()
    method = Method(name="contact_invariants", describe=_features, classifier=Linear)


def contact_invariants_trainer(use_aperture: bool) -> ComparatorTrainer:
    """Return the trainer; the method has no place for the opening."""
    return ComparatorTrainer(kind=ContactInvariants, use_aperture=use_aperture)
