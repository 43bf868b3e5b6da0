"""Resistive matrices on both fingers: from forces to counts, as on open-hardware boards.

Conductance grows with the force and falls with hysteresis. Some current flows through other taxels
of the row and column. The divider compresses the signal far below full scale.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.can.faults import ControlUnitFaults
from simulator.world.world import PhysicalWorld
from tactile.layout import TaxelLayout

Counts = NDArray[np.uint16]


@dataclass(frozen=True, slots=True, kw_only=True)
class ResistiveLaw:
    """Physics of a matrix. All values are assumptions: no published data exist."""

    half_n: float = 2.0
    """Force in N on a taxel at which its conductance is that of the divider."""
    exponent: float = 0.9
    """Exponent of the conductance over the force."""
    hysteresis: float = 0.1
    """Share by which the conductance stays above that of a falling force."""
    row_share: float = 0.25
    column_share: float = 0.15
    """Share of the mean conductance of its row and of its column that is added to a taxel."""
    gain: float = 1.25
    """Full scale of the divider over that of the converter."""
    rest_counts: tuple[float, float] = (40.0, 160.0)
    """Range of the counts without a force, of 1,023."""
    noise_counts: float = 3.0
    """Standard deviation of the noise in counts of 1,023."""


class ResistivePads:
    """The matrices of both fingers, read by 10-bit converters that return 8 bits."""

    def __init__(
        self,
        world: PhysicalWorld,
        layout: TaxelLayout,
        faults: ControlUnitFaults,
        *,
        law: ResistiveLaw | None = None,
        seed: int = 0,
    ) -> None:
        self._world, self._layout, self._faults = world, layout, faults
        self._law = law or ResistiveLaw()
        self._rng = np.random.default_rng([seed, 2])
        self._lagging_n = np.zeros(layout.n_taxels)
        self._rest = self._rng.uniform(*self._law.rest_counts, layout.n_taxels)

    def scan(self) -> Counts:
        """Return the counts of all taxels at this moment, (n_taxels,) uint16 up to 255."""
        law, force_n = self._law, self._world.measured_force_n()
        self._lagging_n = np.clip(self._lagging_n, force_n, (1.0 + law.hysteresis) * force_n)
        conductance = (self._lagging_n / law.half_n) ** law.exponent
        for pad, taxels in ((n, self._layout.taxels_of(n)) for n in range(self._layout.n_pads)):
            matrix = conductance[taxels].reshape(self._layout.pad_shape[pad])
            sneak = law.row_share * matrix.mean(axis=1, keepdims=True)
            sneak = sneak + law.column_share * matrix.mean(axis=0, keepdims=True)
            conductance[taxels] += sneak.ravel()
        counts = 1023.0 * law.gain * conductance / (1.0 + conductance) + self._rest
        counts += self._rng.normal(0.0, law.noise_counts, counts.shape)
        digital = np.clip(np.rint(counts), 0, 1023) // 4
        return self._faults.apply(digital.astype(np.uint16), self._layout.adc_max)
