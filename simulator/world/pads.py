"""Pads that press on one object or on each other: foam, taxels, counts with noise.

The foam is a bed of columns, each a compressible hyperelastic solid that widens nothing sideways
(hyperfoam, Storakers 1986). Under a stretch L of its thickness a column carries the stress

    (E / a) (L^-1 - L^(a - 1))

Between surface and electrodes the pressure spreads as in an elastic layer on a rigid base (Vlasov
and Leontiev 1966): exponentially along each axis. The estimates of shapes assume another law and
another spread, so that their errors here mean something.
"""

import math
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError
from simulator.world.shapes import ObjectPose, Shape, posed_heights
from tactile.layout import Pad

TABLE_STEP_M = 10e-6
"""Spacing in m of the depths in a force table: 1/300 of the foam."""

_LEAST_STRETCH = 0.05
"""Stretch of a column below which the law follows its tangent."""
_SERIES_POINTS = 601
"""Points of the law of two sheets in series: 5 µm of a sheet of 3 mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Foam:
    """A sheet of conductive foam."""

    thickness_m: float = 3e-3
    """Thickness of the sheet in m; the paper's pads have 3 mm."""
    modulus_pa: float = 145e3
    """Young's modulus at small strain in Pa. It gives the paper's threshold: 4.9 kPa at 3.3 %, the
    only interpretation in the range of a foam."""
    exponent: float = 2.0
    """Exponent a of the law, not 0; a smaller one stiffens more. With 2 a compression by 25 % takes
    42 kPa; the data sheet of PORON 4701-30 has 34 to 58 kPa."""
    spread_m: float = 1.22e-3
    """Way in m on which the spreading pressure decays to 1/e: the thickness over the root of 6, of
    a layer with Poisson's ratio 0."""

    def pressure_pa(self, indentation_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressure in Pa of columns with an indentation in m; 0 at a negative one."""
        stretch = 1.0 - np.maximum(indentation_m, 0.0) / self.thickness_m
        a, limited = self.exponent, np.maximum(stretch, _LEAST_STRETCH)
        stress = 1.0 / limited - limited ** (a - 1.0)
        if stretch.min(initial=1.0) < _LEAST_STRETCH:
            slope = _LEAST_STRETCH**-2.0 + (a - 1.0) * _LEAST_STRETCH ** (a - 2.0)
            stress += slope * (limited - stretch)
        pressure_pa: NDArray[np.float64] = (self.modulus_pa / a) * stress
        return pressure_pa


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


_SIGMA_COUNTS = 10.0
"""Standard deviation of the normal distribution in counts; the paper does not give it."""
_LEAST_COUNTS, _LIMIT_COUNTS = 1.0, 20.0
"""The paper's range of the noise in counts."""
_FULL_SCALE_COUNTS = 255.0
"""Full scale of the paper's converter in counts."""


def noise_counts(
    rng: np.random.Generator, n: int, adc_max: int, level: float = 1.0
) -> NDArray[np.float64]:
    """Return the noise of ``n`` samples of a converter in counts, (n,); it is new for each sample.

    The paper adds "values from a normal distribution in the range [1, 20]" to counts of 8 bit: here
    the magnitude of N(0, 10), clipped, and scaled with the full scale of the converter.

    Parameters
    ----------
    level
        Factor from 0 to 4 on all of it; 1 is the paper's upper limit, 8 % of full scale.
    """
    if level == 0.0:
        return np.zeros(n)
    counts = rng.standard_normal(n)
    counts *= _SIGMA_COUNTS
    np.abs(counts, out=counts)
    np.maximum(counts, _LEAST_COUNTS, out=counts)
    np.minimum(counts, _LIMIT_COUNTS, out=counts)
    counts *= level * adc_max / _FULL_SCALE_COUNTS
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
    nodes: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    """Forces in N from 0 on and their counts, with linear interpolation; None: equation (11),
    constant current and an inverting stage."""


EQUATION_11 = SensorLaw()
"""The sensor of the paper."""


def ideal_counts(
    force_n: NDArray[np.float64], adc_max: int, law: SensorLaw = EQUATION_11
) -> NDArray[np.float64]:
    """Return the counts under ``force_n`` N, before noise, limits and rounding."""
    measured_n = law.gain * force_n
    if law.nodes is not None:
        return np.interp(measured_n, *law.nodes)
    return adc_max * (1.0 - resistance_mohm(measured_n) / RESISTANCE_AT_REST_MOHM)


class PressureGrid:
    """A fine grid over one pad, and the spreading of its pressure to the taxels.

    The cells of the grid divide the taxels evenly. The pressure of a cell spreads exponentially
    along each axis, mirrored at the edges of the pad, so that no force is lost. A taxel measures
    the force on its area. Both directions are independent: two small matrices do spreading and
    integration.
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
    share = np.zeros((n_taxels, len(centres_m)))
    # The mirror images at both edges replace the force that would be lost beyond them.
    for image_m in (centres_m, 2.0 * half_m - centres_m, -2.0 * half_m - centres_m):
        away = (taxel_edges_m[:, np.newaxis] - image_m) / spread_m
        share -= 0.5 * np.diff(np.sign(away) * np.expm1(-np.abs(away)), axis=0)
    return centres_m, share / share.sum(axis=0)


NEST_FRICTION_N = 0.05
"""Force in N that moves the object along the closing axis, against the friction of its nest."""
_SETTLED_N = 1e-6
"""Difference of the pads' forces in N below which the object counts as settled."""
_SETTLE_STEPS = 60
"""Most Newton or bisection steps: bisection reaches the precision of a float within them."""
_COARSE = 4
"""Step of the coarse grid in cells, for pads that meet each other."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PadPair:
    """Position of the two gripping pads, and their differences."""

    shift_m: tuple[float, float] = (0.0, 0.0)
    """Offset of finger 1's pad from finger 0's, along and across the fingers, in m, at most 5 mm.
    """
    tilt_rad: tuple[float, float] = (0.0, 0.0)
    """Angle between the pads along and across the fingers, positive where the gap closes, in rad,
    at most 10 degrees."""
    gains: tuple[float, float] = (1.0, 1.0)
    """Factors from 0.1 to 10 on the measured force of the taxels of finger 0 and finger 1."""
    stiffness: tuple[float, float] = (1.0, 1.0)
    """Factors from 0.1 to 10 on the modulus of their foam."""

    def foams(self, foam: Foam) -> tuple[Foam, Foam]:
        """Return the foam of each finger's pad, from one sheet."""
        first, second = (replace(foam, modulus_pa=foam.modulus_pa * s) for s in self.stiffness)
        return first, second


class PadsMeet:
    """The two pads pressing on each other, foam on foam, without an object.

    Parameters
    ----------
    grids
        Inner pad of finger 0 and of finger 1.
    foams
        The sheets on them.
    pair
        Their position and differences.
    """

    def __init__(
        self, grids: tuple[PressureGrid, ...], foams: tuple[Foam, Foam], pair: PadPair
    ) -> None:
        self._grids = grids
        self._foam = FoamPair(foams)
        self._pair = pair
        # Reach of each pad's taxel field towards the other pad.
        self._reach_m = tuple(self._reach(side) for side in (0, 1))
        self.highest_m = float(self._reach_m[0].max())
        """Opening in m below which the pads touch each other."""

    def _reach(self, side: int) -> NDArray[np.float64]:
        """Return the depth of a pad's cells in the other pad in m, relative to the middle."""
        grid, other = self._grids[side], self._grids[1 - side]
        (shift_x_m, shift_y_m), (tilt_x, tilt_y) = self._pair.shift_m, self._pair.tilt_rad
        x_m, y_m = np.broadcast_arrays(grid.x_m, grid.y_m)
        sign = 1.0 if side == 0 else -1.0
        # Positions of the cells on the other pad.
        there_x_m, there_y_m = x_m - sign * shift_x_m, y_m - sign * shift_y_m
        met = (np.abs(there_x_m) <= other.half_x_m) & (np.abs(there_y_m) <= other.half_y_m)
        # The gap is given in the coordinates of finger 0.
        at_x_m, at_y_m = (x_m, y_m) if side == 0 else (there_x_m, there_y_m)
        return np.where(met, math.tan(tilt_x) * at_x_m + math.tan(tilt_y) * at_y_m, -np.inf)

    def settle(
        self, position_m: tuple[float, float]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return force in N and stiffness in N/m on each pad at half openings in m."""
        opening_m = position_m[0] + position_m[1]
        if opening_m >= self.highest_m:
            return (0.0, 0.0), (0.0, 0.0)
        table = self._forces
        force_n, stiffness_n_m = table.lookup(table.reach_max_m - opening_m)
        return (force_n, force_n), (stiffness_n_m, stiffness_n_m)

    @cached_property
    def _forces(self) -> ForceTable:
        """Force over depth, computed when the pads first meet."""
        reach_m = self._reach_m[0]
        coarse_m = reach_m[_COARSE // 2 :: _COARSE, _COARSE // 2 :: _COARSE]
        area_m2 = self._grids[0].cell_area_m2 * np.isfinite(reach_m).sum()
        return ForceTable(self._foam, coarse_m, area_m2 / np.isfinite(coarse_m).sum())

    def taxel_force_n(self, side: int, position_m: tuple[float, float]) -> NDArray[np.float64]:
        """Return the force in N on each taxel of one pad, shape (rows * columns,), row-major."""
        (total_n, _), _ = self.settle(position_m)
        depth_m = self._reach_m[side] - position_m[0] - position_m[1]
        grid = self._grids[side]
        whole = (slice(None), slice(None))
        pressure_pa = self._foam.pressure_pa(np.maximum(depth_m, 0.0))
        force_n = grid.taxel_force_n(pressure_pa, grid.shares(whole))
        # Both pads have the same force, although their grids differ at the edges.
        return force_n * (total_n / max(float(force_n.sum()), 1e-12))


class Press:
    """A rigid object between the pads.

    In the grip its pose in the plane of the pads is fixed. So height maps and force over depth are
    computed once for each pad. The object moves only along the closing axis, without inertia,
    against the friction of its nest. Raises SimulatorSettingsError if the object lies beside a pad.

    Parameters
    ----------
    grids
        Inner pad of finger 0 and of finger 1.
    """

    def __init__(
        self,
        shape: Shape,
        pose: ObjectPose,
        grids: tuple[PressureGrid, ...],
        foams: tuple[Foam, Foam],
    ) -> None:
        self.z_m = pose.z_m
        """Offset of the object along the closing axis in m, towards finger 1."""
        self.swell_m = 0.0
        """Additional reach of the object towards each finger in m."""
        self._foams = foams
        self._grids = grids
        tables: list[ForceTable] = []
        shares: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        lags_m: list[NDArray[np.float64]] = []
        seen: PressureGrid | None = None
        for side, grid in enumerate(grids):
            if seen is None or not grid.same_points_as(seen):
                heights_m = posed_heights(shape, pose, *np.broadcast_arrays(grid.x_m, grid.y_m))
                seen = grid
            reach_m = heights_m[side]
            covered: NDArray[np.bool_] = np.isfinite(reach_m)
            if not covered.any():
                raise SimulatorSettingsError(
                    f"at x = {1e3 * pose.x_m:.1f} mm, y = {1e3 * pose.y_m:.1f} mm the object lies "
                    f"beside the pad {grid.pad.name}; choose a smaller offset"
                )
            window = (_span(covered, axis=0), _span(covered, axis=1))
            # The sides of most objects are alike, and have one table.
            alike = foams[0] == foams[1] and np.array_equal(*heights_m)
            if not (tables and seen is grids[0] and alike):
                table = ForceTable(foams[side], reach_m[window], grid.cell_area_m2)
            tables.append(table)
            shares.append(grid.shares(window))
            lags_m.append(table.reach_max_m - reach_m[window])
        self._tables = (tables[0], tables[1])
        self._shares = shares
        self._lag_m = lags_m

    @property
    def reach_m(self) -> tuple[float, float]:
        """Reach of the object from its centre towards finger 0 and finger 1 in m."""
        return self._tables[0].reach_max_m, self._tables[1].reach_max_m

    def _depths_m(self, position_m: tuple[float, float]) -> tuple[float, float]:
        near, far = self._tables
        return (
            near.reach_max_m + self.swell_m - self.z_m - position_m[0],
            far.reach_max_m + self.swell_m + self.z_m - position_m[1],
        )

    def settle(
        self, position_m: tuple[float, float]
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Move the object to its equilibrium between the pads and its nest.

        It moves until the forces of the pads differ by no more than the friction of the nest.

        Parameters
        ----------
        position_m
            Half openings of finger 0 and finger 1 in m.

        Returns
        -------
        force_n, stiffness_n_m
            Force on each pad in N, and its decrease per opening of the finger in N/m.
        """
        near, far = self._tables
        depth_0, depth_1 = self._depths_m(position_m)
        if depth_0 <= 0.0 and depth_1 <= 0.0:
            return (0.0, 0.0), (0.0, 0.0)
        force_0, slope_0 = near.lookup(depth_0)
        force_1, slope_1 = far.lookup(depth_1)
        net_n = force_0 - force_1
        if abs(net_n) > NEST_FRICTION_N:
            goal_n = math.copysign(NEST_FRICTION_N, net_n)
            # Sought: the shift at which net force = goal. The stronger side's depth bounds it.
            low_m, high_m = (0.0, depth_0) if net_n > 0.0 else (-depth_1, 0.0)
            shift_m = 0.0
            for _ in range(_SETTLE_STEPS):
                error_n = net_n - goal_n
                if abs(error_n) < _SETTLED_N:
                    break
                if error_n > 0.0:
                    low_m = shift_m
                else:
                    high_m = shift_m
                slope = slope_0 + slope_1
                shift_m = shift_m + error_n / slope if slope > 0.0 else high_m
                if not low_m < shift_m < high_m:
                    shift_m = 0.5 * (low_m + high_m)
                force_0, slope_0 = near.lookup(depth_0 - shift_m)
                force_1, slope_1 = far.lookup(depth_1 + shift_m)
                net_n = force_0 - force_1
            self.z_m += shift_m
        return (force_0, force_1), (slope_0, slope_1)

    def taxel_force_n(self, side: int, position_m: tuple[float, float]) -> NDArray[np.float64]:
        """Return the force in N on each taxel of one pad, shape (rows * columns,), row-major."""
        depth_m = self._depths_m(position_m)[side]
        pressure_pa = self._foams[side].pressure_pa(depth_m - self._lag_m[side])
        return self._grids[side].taxel_force_n(pressure_pa, self._shares[side])


def _span(covered: NDArray[np.bool_], *, axis: int) -> slice:
    """Return the range along an axis that contains all covered cells."""
    indices = np.nonzero(covered)[axis]
    return slice(int(indices.min()), int(indices.max()) + 1)
