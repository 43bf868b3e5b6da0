"""Contact of the pads with one object at one pose, or with each other: forces and pressures."""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError
from simulator.world.foam import Foam, FoamPair, ForceTable
from simulator.world.shapes import ObjectPose, Shape, posed_heights
from simulator.world.taxels import PressureGrid

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
        self._highest_m = float(self._reach_m[0].max())

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
        if opening_m >= self._highest_m:
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
