"""What the opening between the fingers tells: size of the object, and how it yields."""

import numpy as np
from numpy.typing import NDArray

from recognition.ramp_levels import Levels

_YIELD_SCALE_MM = 1 / 3


def aperture_features(levels: Levels) -> NDArray[np.float64]:
    """Return (n, F): sizes in mm and their logarithms, and by how much the load closes the gap.

    NaN where the opening is unknown.
    """
    final = levels.aperture_mm[:, -1:]
    both = levels.touch_aperture_mm.min(axis=1, keepdims=True)
    first = levels.touch_aperture_mm[:, :1] - levels.touch_aperture_mm[:, -1:]
    squeeze = both - final
    sizes = np.concatenate([final, both], axis=1)
    return np.concatenate(
        [
            sizes,
            np.log(np.maximum(sizes, 0.0) + 3.0),
            first,
            squeeze,
            np.arcsinh(squeeze / _YIELD_SCALE_MM),
            np.arcsinh((levels.aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
            np.arcsinh((levels.timed_aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
        ],
        axis=1,
    )
