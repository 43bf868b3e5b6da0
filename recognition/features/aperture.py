"""Features of the opening: size of the object, and its compression under load."""

import numpy as np
from numpy.typing import NDArray

from recognition.ramp.levels import Levels

_YIELD_SCALE_MM = 1 / 3
"""Yield in mm up to which its inverse hyperbolic sine is linear; beyond it grows as a logarithm."""
_SIZE_OFFSET_MM = 3.0
"""Added to a size before its logarithm, in mm, so that small sizes do not dominate."""


def sizes_mm(levels: Levels) -> NDArray[np.float64]:
    """Return (n, 2): the opening in mm under the full load, and at the first touch of both pads."""
    return np.stack([levels.aperture_mm[:, -1], levels.touch_aperture_mm.min(axis=1)], axis=1)


def aperture_features(levels: Levels) -> NDArray[np.float64]:
    """Return (n, F): sizes in mm and their logarithms, and the closing of the fingers by the load.

    NaN if the opening is unknown.
    """
    sizes = sizes_mm(levels)
    final, both = sizes[:, :1], sizes[:, 1:]
    first = levels.touch_aperture_mm[:, :1] - levels.touch_aperture_mm[:, -1:]
    squeeze = both - final
    return np.concatenate(
        [
            sizes,
            np.log(np.maximum(sizes, 0.0) + _SIZE_OFFSET_MM),
            first,
            squeeze,
            np.arcsinh(squeeze / _YIELD_SCALE_MM),
            np.arcsinh((levels.aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
            np.arcsinh((levels.timed_aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
        ],
        axis=1,
    )
