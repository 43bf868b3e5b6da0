"""Features of growth: change of patch and load along the ramp."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from recognition.features.footprint import LOAD_FLOOR, Footprint
from recognition.ramp.levels import Levels

_TIME_FLOOR_S = 0.05
"""Added to times before their logarithm, in s, so that smaller differences hardly count."""


def growth_features(levels: Levels, footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): growth of patch and load over the levels, load over time, times of the levels.

    They show curvature, compliance and creep.
    """
    n = len(levels)
    parts: list[NDArray[np.float64]] = []
    for print_ in footprints:
        extent, axes = print_.log_extent[..., 0], print_.log_axes
        parts.append((extent[:, -1] - extent[:, 0])[:, None])
        parts.append(axes[:, -1, :2] - axes[:, 0, :2])
        parts.append(print_.log_load[:, -1:] - print_.log_load[:, :-1])
    timed = np.log(np.maximum(levels.timed_load, 0.0) + LOAD_FLOOR)
    parts.append((timed[..., -1:] - timed[..., :-1]).reshape(n, -1))
    parts.append(np.log(np.maximum(levels.level_time_s, 0.0) + _TIME_FLOOR_S))
    parts.append(levels.touch_delay_s[:, None])
    return np.concatenate(parts, axis=1)
