"""Resistive matrices on both fingers: from forces to counts, as on open-hardware boards.

Conductance grows with the force and falls with hysteresis. Some current flows through other taxels
of the row and column. The divider compresses the signal far below full scale. All figures are
assumptions: no published data exist.
"""

import numpy as np
from numpy.typing import NDArray

from simulator.can.faults import ControlUnitFaults
from simulator.world.world import PhysicalWorld
from tactile.layout import TaxelLayout

Counts = NDArray[np.uint16]


_HALF_N = 2.0
"""Force in N on a taxel at which its conductance is that of the divider."""
_EXPONENT = 0.9
"""Exponent of the conductance over the force."""
_HYSTERESIS = 0.1
"""Share by which the conductance stays above that of a falling force."""
_ROW_SHARE, _COLUMN_SHARE = 0.25, 0.15
"""Share of the mean conductance of its row and of its column that is added to a taxel."""
_GAIN = 1.25
"""Full scale of the divider over that of the converter."""
_REST_COUNTS = (40.0, 160.0)
"""Range of the counts without a force, of 1,023."""
_NOISE_COUNTS = 3.0
"""Standard deviation of the noise in counts of 1,023."""


class ResistivePads:
    """The matrices of both fingers, read by 10-bit converters that return 8 bits."""

    def __init__(
        self, world: PhysicalWorld, layout: TaxelLayout, faults: ControlUnitFaults, *, seed: int = 0
    ) -> None:
        self._world, self._layout, self._faults = world, layout, faults
        self._rng = np.random.default_rng([seed, 2])
        self._lagging_n = np.zeros(layout.n_taxels)
        self._rest = self._rng.uniform(*_REST_COUNTS, layout.n_taxels)

    def scan(self) -> Counts:
        """Return the counts of all taxels at this moment, (n_taxels,) uint16 up to 255."""
        force_n = self._world.measured_force_n()
        self._lagging_n = np.clip(self._lagging_n, force_n, (1.0 + _HYSTERESIS) * force_n)
        conductance = (self._lagging_n / _HALF_N) ** _EXPONENT
        for pad, taxels in ((n, self._layout.taxels_of(n)) for n in range(self._layout.n_pads)):
            matrix = conductance[taxels].reshape(self._layout.pad_shape[pad])
            sneak = _ROW_SHARE * matrix.mean(axis=1, keepdims=True)
            sneak = sneak + _COLUMN_SHARE * matrix.mean(axis=0, keepdims=True)
            conductance[taxels] += sneak.ravel()
        counts = 1023.0 * _GAIN * conductance / (1.0 + conductance) + self._rest
        counts += self._rng.normal(0.0, _NOISE_COUNTS, counts.shape)
        digital = np.clip(np.rint(counts), 0, 1023) // 4
        return self._faults.apply(digital.astype(np.uint16), self._layout.adc_max)
