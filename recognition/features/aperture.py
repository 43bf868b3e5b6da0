"""Features of the opening between the fingers: size of the object, and its yield under load."""

import numpy as np
from numpy.typing import NDArray

from recognition.ramp.levels import Levels

_YIELD_SCALE_MM = 1 / 3
"""Yield in mm up to which its inverse hyperbolic sine is linear; beyond it grows as a logarithm."""
_SIZE_OFFSET_MM = 3.0
"""Added to a size before its logarithm, in mm: small sizes would dominate without it."""


def aperture_features(levels: Levels) -> NDArray[np.float64]:
    """Return (n, F): sizes in mm and their logarithms, and how far the load closes the fingers.

    NaN where the opening is unknown.
    """
    final = levels.aperture_mm[:, -1:]
    both = levels.touch_aperture_mm.min(axis=1, keepdims=True)
    first = levels.touch_aperture_mm[:, :1] - levels.touch_aperture_mm[:, -1:]
    squeeze = both - final
    return np.concatenate(
        [
            _sizes(np.concatenate([final, both], axis=1)),
            first,
            squeeze,
            np.arcsinh(squeeze / _YIELD_SCALE_MM),
            np.arcsinh((levels.aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
            np.arcsinh((levels.timed_aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
        ],
        axis=1,
    )


def _sizes(sizes_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (..., 2 k) for (..., k): the sizes, and their logarithms from 3 mm on."""
    return np.concatenate([sizes_mm, np.log(np.maximum(sizes_mm, 0.0) + _SIZE_OFFSET_MM)], axis=-1)
