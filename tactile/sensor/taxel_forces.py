"""Forces on the taxels of a single frame, for displays, by the present law and zero."""

from copy import copy

import numpy as np
from numpy.typing import NDArray

from tactile.layout import TaxelLayout
from tactile.sensor.calibration import Calibration
from tactile.sensor.filters import (
    ActiveTaxels,
    Neighbourhood,
    fill_bad,
    typical_noise,
)
from tactile.sensor.tare import TareResult


class TaxelForces:
    """Converts counts of single frames to newtons, as the sensor does with the mean of several."""

    def __init__(self, layout: TaxelLayout, calibration: Calibration, zero: TareResult) -> None:
        self._hood = Neighbourhood(layout)
        self._calibration = calibration
        self._zero = zero
        # Counts are integers, so smaller noise is not visible.
        noise = typical_noise(layout, zero.noise_counts, 1.0)
        self._untouched = ActiveTaxels(self._hood, noise)

    def of(self, counts: NDArray[np.uint16]) -> NDArray[np.float32]:
        """Return the force in N on each taxel, (n_taxels,) float32; 0 on untouched taxels."""
        bad = self._zero.health.bad
        tared = fill_bad(self._hood, counts - self._zero.offset_counts, bad)
        # A copy, because frames are independent and come from several threads.
        active = copy(self._untouched).step(tared)
        force_n = np.where(active, self._calibration.force_n(tared), 0.0)
        return np.maximum(force_n, 0.0).astype(np.float32)
