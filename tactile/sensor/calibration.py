"""Calibrations from counts to newtons: the law of the paper's foam, and a table.

The foam's resistance falls with the force F on a taxel, equation (11) of the paper:
R = 1.579 exp(-0.449 F) - 8.365e-11 exp(-32.34 F), R in MΩ and F in N. The second term is below
1e-10 MΩ everywhere and is left out. The converter reads the inverted voltage of a constant current:
counts = adc_max (1 - R / R0) with R0 = R(0). So R0 itself cancels, and 0 N gives 0 counts.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tactile.errors import CalibrationError

FOAM_EXPONENT_PER_N = 0.449
"""Decay of the resistance over the force in 1/N, equation (11)."""
Array = NDArray[np.float64]


class Calibration(Protocol):
    """Converts tared counts into forces, taxel by taxel."""

    @property
    def adc_max(self) -> int:
        """Full scale of the counts."""

    def force_n(self, tared_counts: Array) -> Array:
        """Return the force on each taxel in N, same shape; odd in the noise around zero."""


def _check(calibration: "FoamCalibration | TableCalibration") -> None:
    """Check full scale and gain, and keep a copy of the gain that is not written."""
    if calibration.adc_max < 1:
        raise CalibrationError(f"adc_max is {calibration.adc_max}, must be at least 1")
    gain = np.array(calibration.gain, dtype=np.float64)
    if not np.all(np.isfinite(gain) & (gain > 0.0)):
        raise CalibrationError("taxel gains must be finite and above 0")
    gain.setflags(write=False)
    object.__setattr__(calibration, "gain", gain)


@dataclass(frozen=True, slots=True, eq=False)
class FoamCalibration:
    """The paper's foam, equation (11), behind the inverted constant-current converter.

    Below zero the law continues as its tangent, so that noise around zero averages out. At full
    scale it gives the smallest force that is rounded to full scale. A taxel there is saturated, and
    its force may be larger.
    """

    adc_max: int
    """Full scale in counts."""
    gain: Array | float = 1.0
    """(n_taxels,) float64 or scalar: true force over the law's force of each taxel."""

    def __post_init__(self) -> None:
        _check(self)

    def force_n(self, tared_counts: Array) -> Array:
        """Return the force on each taxel in N."""
        counts = np.minimum(np.asarray(tared_counts, dtype=np.float64), self.adc_max - 0.5)
        share = counts / self.adc_max
        law = -np.log1p(-np.maximum(share, 0.0)) + np.minimum(share, 0.0)
        return np.asarray(self.gain * law / FOAM_EXPONENT_PER_N, dtype=np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class TableCalibration:
    """A sensor that was measured at some counts: straight lines between them, from 0 N on.

    One node is a sensor whose counts are proportional to the force. Beyond the last node, and below
    zero, the nearest line continues. Raises CalibrationError unless counts and forces rise together
    from above 0.
    """

    node_counts: tuple[float, ...]
    node_force_n: tuple[float, ...]
    """(n,) each: tared counts, and the force on one taxel in N."""
    adc_max: int
    """Full scale in counts."""
    gain: Array | float = 1.0
    """(n_taxels,) float64 or scalar: true force over that of the table."""

    def __post_init__(self) -> None:
        _check(self)
        nodes = np.array([(0.0, *self.node_counts), (0.0, *self.node_force_n)])
        if nodes.shape[1] < 2 or not (np.isfinite(nodes).all() and (np.diff(nodes) > 0.0).all()):
            raise CalibrationError("counts and forces of a table must rise from above 0, together")

    def force_n(self, tared_counts: Array) -> Array:
        """Return the force on each taxel in N."""
        nodes = np.array([(0.0, *self.node_counts), (0.0, *self.node_force_n)])
        slopes = np.divide(*np.diff(nodes)[::-1])
        line = np.clip(np.searchsorted(nodes[0], tared_counts, "right") - 1, 0, len(slopes) - 1)
        law = nodes[1, line] + slopes[line] * (np.asarray(tared_counts) - nodes[0, line])
        return np.asarray(self.gain * law, dtype=np.float64)
