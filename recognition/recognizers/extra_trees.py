"""Extremely randomised trees on moments of the patches: today's plain choice.

Size, extent, moments and harmonics of both patches along the ramp, their differences and growth;
with the opening where it is to be used.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features import feature_groups
from recognition.features_footprint import PadGrid
from recognition.ramp_levels import Levels
from recognition.recognizers._comparator import Comparator, ComparatorTrainer, Method
from recognition.recognizers._forest import Forest

_GROUPS = ("patch", "pads", "growth")


def _features(levels: Levels, grids: Sequence[PadGrid], use_aperture: bool) -> NDArray[np.float64]:
    groups = feature_groups(levels, grids)
    names = (*_GROUPS, "aperture") if use_aperture else _GROUPS
    return np.concatenate([groups[name] for name in names if name in groups], axis=1)


class ExtraTrees(Comparator):
    """Classifies moments."""

    __slots__ = ()
    method = Method(name="extra_trees", describe=_features, classifier=Forest, knows_aperture=True)


def extra_trees_trainer(use_aperture: bool) -> ComparatorTrainer:
    """Return the trainer."""
    return ComparatorTrainer(kind=ExtraTrees, use_aperture=use_aperture)
