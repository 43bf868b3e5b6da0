"""The foam on a pad: its pressure on a rigid surface.

The foam is a bed of columns, each with the non-linear law of an elastomeric foam: first linear,
then stiffening as its cells close (densification). Between surface and electrodes the pressure
spreads: see `simulator.world.taxels`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

TABLE_STEP_M = 10e-6
"""Spacing in m of the depths in a force table: 1/300 of the foam."""

_LIMIT_STRAIN = 0.9
"""Strain above which the law follows its tangent."""
_SERIES_POINTS = 601
"""Points of the law of two sheets in series: 5 µm of a sheet of 3 mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Foam:
    """A sheet of conductive foam."""

    thickness_m: float = 3e-3
    """Thickness of the sheet in m; the paper's pads have 3 mm."""
    modulus_pa: float = 150e3
    """Young's modulus at small strain in Pa: 150 kPa, the only interpretation of the paper's
    threshold (4.9 kPa at 3.3 % strain) in the range of a foam."""
    densification: float = 0.5
    """Stiffening: at a strain of one half the secant modulus is ``1 + densification`` times the
    modulus."""
    spread_m: float = 1.5e-3
    """Standard deviation in m of the spreading of a pressure on its way through the sheet: about
    half the thickness."""

    def pressure_pa(self, indentation_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressure in Pa of columns with an indentation in m.

        With strain e the pressure is E e (1 + d (e / (1 - e))^2); 0 at negative indentation.
        """
        strain = np.maximum(indentation_m, 0.0)
        strain /= self.thickness_m
        bent = np.minimum(strain, _LIMIT_STRAIN)
        closing = bent / (1.0 - bent)
        stress = bent * (1.0 + self.densification * closing**2)
        if strain.max(initial=0.0) <= _LIMIT_STRAIN:
            stress *= self.modulus_pa
            return stress
        limit_closing = _LIMIT_STRAIN / (1.0 - _LIMIT_STRAIN)
        tangent = 1.0 + self.densification * limit_closing**2 * (1.0 + 2.0 / (1.0 - _LIMIT_STRAIN))
        return self.modulus_pa * (stress + tangent * (strain - bent))


class FoamPair:
    """Two sheets of foam that are pressed into each other: columns in series, one pressure."""

    def __init__(self, foams: tuple[Foam, Foam]) -> None:
        self.thickness_m = foams[0].thickness_m + foams[1].thickness_m
        """Thickness of both sheets together in m."""
        first_m = np.linspace(0.0, foams[0].thickness_m, _SERIES_POINTS)
        second_m = np.linspace(0.0, foams[1].thickness_m, _SERIES_POINTS)
        self._pressure_pa = foams[0].pressure_pa(first_m)
        self._indentation_m = first_m + np.interp(
            self._pressure_pa, foams[1].pressure_pa(second_m), second_m
        )

    def pressure_pa(self, indentation_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressure in Pa of columns with a total indentation in m."""
        return np.interp(indentation_m, self._indentation_m, self._pressure_pa)


class ForceTable:
    """Force over depth of one surface against foam; depths are computed at their first use.

    So placing an object is fast, and in real time the buses do not wait.

    Parameters
    ----------
    foam
        The pad's foam, under a rigid surface, or that of two pads that meet.
    reach_m
        Reach of the surface towards the pad in m over a grid, -inf outside the surface.
    cell_area_m2
        Area of a cell of the grid in m².
    """

    def __init__(
        self, foam: Foam | FoamPair, reach_m: NDArray[np.float64], cell_area_m2: float
    ) -> None:
        surface_m = reach_m[np.isfinite(reach_m)]
        self.reach_max_m = float(surface_m.max())
        """Highest point of the surface in m."""
        self._foam = foam
        self._lag_m = self.reach_max_m - np.sort(surface_m)[::-1]
        self._cell_area_m2 = cell_area_m2
        self._last = math.ceil(foam.thickness_m / TABLE_STEP_M) - 1
        # Force in N by the number of steps; None: not computed.
        self._force_n: list[float | None] = [None] * (self._last + 2)

    def lookup(self, depth_m: float) -> tuple[float, float]:
        """Return force in N and stiffness in N/m when the highest point is ``depth_m`` m deep."""
        if depth_m <= 0.0:
            return 0.0, 0.0
        i = int(depth_m / TABLE_STEP_M)
        i = i if i < self._last else self._last
        force_n, next_n = self._force_n[i], self._force_n[i + 1]
        if force_n is None:
            force_n = self._at(i)
        if next_n is None:
            next_n = self._at(i + 1)
        stiffness_n_m = (next_n - force_n) / TABLE_STEP_M
        return force_n + stiffness_n_m * (depth_m - i * TABLE_STEP_M), stiffness_n_m

    def _at(self, i: int) -> float:
        """Compute the force in N at a depth of ``i`` steps."""
        depth_m = i * TABLE_STEP_M
        pressed = np.searchsorted(self._lag_m, depth_m, side="right")
        pressure_pa = self._foam.pressure_pa(depth_m - self._lag_m[:pressed])
        force_n = self._force_n[i] = float(pressure_pa.sum() * self._cell_area_m2)
        return force_n
