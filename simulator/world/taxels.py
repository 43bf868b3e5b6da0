"""Taxels of a pad: from the pressure on the foam to counts, with the noise of the converter."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simulator.world.foam import Foam
from tactile.layout import Pad

NoiseKind = Literal["clipped_normal", "none"]

_SIGMA_COUNTS = 10.0
"""Standard deviation of the normal distribution in counts; the paper does not give it."""
_LEAST_COUNTS, _LIMIT_COUNTS = 1.0, 20.0
"""The paper's range of the noise in counts."""
_FULL_SCALE_COUNTS = 255.0
"""Full scale of the paper's converter in counts."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseModel:
    """Noise of the converter, new for each taxel and each frame.

    The paper adds "values from a normal distribution in the range [1, 20]" to counts of 8 bit. They
    are scaled with the full scale of the converter.
    """

    kind: NoiseKind = "clipped_normal"
    """``clipped_normal``: the magnitude of N(0, 10) clipped to [1, 20]. ``none``: nothing."""
    level: float = 1.0
    """Factor from 0 to 4 on all of it; 1 is the paper's upper limit, 8 % of full scale."""

    def sample(self, rng: np.random.Generator, n: int, adc_max: int) -> NDArray[np.float64]:
        """Return noise in counts for ``n`` taxels of a converter with full scale ``adc_max``."""
        if self.kind == "none" or self.level == 0.0:
            return np.zeros(n)
        counts = rng.standard_normal(n)
        counts *= _SIGMA_COUNTS
        np.abs(counts, out=counts)
        np.maximum(counts, _LEAST_COUNTS, out=counts)
        np.minimum(counts, _LIMIT_COUNTS, out=counts)
        counts *= self.level * adc_max / _FULL_SCALE_COUNTS
        return counts


CELL_M = 0.35e-3
"""Longest side in m of a cell of the pressure grid."""

RESISTANCE_AT_REST_MOHM = 1.579
"""Resistance of an untouched taxel in MOhm, equation (11) of the paper."""
RESISTANCE_DECAY_PER_N = 0.449
"""Decay of the resistance over the force in 1/N, equation (11) of the paper."""


def resistance_mohm(force_n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the resistance in MOhm of taxels under ``force_n`` N: equation (11), first term.

    The second term is below 1e-10 MOhm at all forces.
    """
    return RESISTANCE_AT_REST_MOHM * np.exp(-RESISTANCE_DECAY_PER_N * force_n)


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorLaw:
    """Law from force to counts; without force the converter reads 0."""

    gain: float = 1.0
    """Factor on the force of a taxel."""
    full_scale_n: float | None = None
    """Force in N at full scale of a sensor with counts proportional to the force; None: equation
    (11), constant current and an inverting stage."""
    nodes: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Forces in N from 0 on and their counts, with linear interpolation."""


EQUATION_11 = SensorLaw()
"""The sensor of the paper."""


def ideal_counts(
    force_n: NDArray[np.float64], adc_max: int, law: SensorLaw = EQUATION_11
) -> NDArray[np.float64]:
    """Return the counts under ``force_n`` N, before noise, limits and rounding."""
    measured_n = law.gain * force_n
    if law.full_scale_n is not None:
        return adc_max * (measured_n / law.full_scale_n)
    if law.nodes is not None:
        return np.interp(measured_n, *law.nodes)
    return adc_max * (1.0 - resistance_mohm(measured_n) / RESISTANCE_AT_REST_MOHM)


class PressureGrid:
    """A fine grid over one pad, and the spreading of its pressure to the taxels.

    The cells of the grid divide the taxels evenly. The pressure of a cell spreads as a Gaussian,
    mirrored at the edges of the pad, so that no force is lost. A taxel measures the force on its
    area. Both directions are independent: two small matrices do spreading and integration.
    """

    def __init__(self, pad: Pad, foam: Foam) -> None:
        self.pad = pad
        x_m, self._along = _share_of_taxels(pad.rows, pad.pitch_x_m, foam.spread_m)
        y_m, across = _share_of_taxels(pad.columns, pad.pitch_y_m, foam.spread_m)
        self._across = across.T
        self.x_m = x_m[:, np.newaxis]
        self.y_m = y_m[np.newaxis, :]
        """(n_x, 1) and (1, n_y) float64: centres of the grid's cells in the pad's plane in m."""
        self.half_x_m = 0.5 * pad.rows * pad.pitch_x_m
        self.half_y_m = 0.5 * pad.columns * pad.pitch_y_m
        """Half of its extent in m."""
        self.cell_area_m2 = float((x_m[1] - x_m[0]) * (y_m[1] - y_m[0]))
        """Area of a cell in m²."""

    def same_points_as(self, other: "PressureGrid") -> bool:
        """Return whether two grids have their cells at the same points of their pads' planes."""
        return np.array_equal(self.x_m, other.x_m) and np.array_equal(self.y_m, other.y_m)

    def shares(
        self, window: tuple[slice, slice]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the taxels' shares of the rows and of the columns of a window of the grid."""
        rows, columns = window
        return np.ascontiguousarray(self._along[:, rows]), self._across[columns]

    def taxel_force_n(
        self,
        pressure_pa: NDArray[np.float64],
        shares: tuple[NDArray[np.float64], NDArray[np.float64]],
    ) -> NDArray[np.float64]:
        """Return the force in N on each taxel, shape (rows * columns,), row-major.

        Parameters
        ----------
        pressure_pa
            Pressure in Pa on the cells of a window; the pressure elsewhere is 0.
        shares
            Shares of that window, from `shares`.
        """
        along, across = shares
        force_n: NDArray[np.float64] = along @ pressure_pa @ across
        force_n *= self.cell_area_m2
        return force_n.ravel()


@cache
def _share_of_taxels(
    n_taxels: int, pitch_m: float, spread_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cell centres (n,) in m and each taxel's share of each cell, (n_taxels, n)."""
    per_taxel = max(2, math.ceil(pitch_m / CELL_M))
    half_m = 0.5 * n_taxels * pitch_m
    edges_m = np.linspace(-half_m, half_m, n_taxels * per_taxel + 1)
    centres_m = 0.5 * (edges_m[:-1] + edges_m[1:])
    taxel_edges_m = edges_m[::per_taxel]
    erf = np.vectorize(math.erf, otypes=[np.float64])
    share = np.zeros((n_taxels, len(centres_m)))
    # The mirror images at both edges replace the force that would be lost beyond them.
    for image_m in (centres_m, 2.0 * half_m - centres_m, -2.0 * half_m - centres_m):
        reached = erf((taxel_edges_m[:, np.newaxis] - image_m) / (math.sqrt(2.0) * spread_m))
        share += 0.5 * np.diff(reached, axis=0)
    return centres_m, share / share.sum(axis=0)
