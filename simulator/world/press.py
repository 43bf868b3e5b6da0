"""One object at one pose between two pads: forces, equilibrium, pressures."""

import math

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError
from simulator.world.foam import Foam, ForceTable
from simulator.world.shapes import ObjectPose, Shape, posed_heights
from simulator.world.taxels import PadGrid

_SETTLED_N = 1e-6
"""Difference of the pads' forces in N below which the object counts as settled."""
_SETTLE_STEPS = 60
"""Most Newton or bisection steps: bisection alone reaches the limit of a float in so many."""


class Press:
    """A rigid object that the pads press from both sides.

    The pose in the plane of the pads is fixed while it is gripped, so all that depends on it is
    worked out once: height maps, and force over depth for each pad. The object moves along the
    closing axis only, without inertia, against the friction of its nest.

    Parameters
    ----------
    shape, pose
        The object and where it is.
    grids
        Inner pad of finger 0 and of finger 1.
    foam
        The sheet on both pads.

    Attributes
    ----------
    z_m
        Offset of the object along the closing axis in m, towards finger 1.
    swell_m
        How much more than its shape the object reaches towards each finger in m.

    Raises
    ------
    SimulatorSettingsError
        If the object lies beside a pad.
    """

    def __init__(
        self, shape: Shape, pose: ObjectPose, grids: tuple[PadGrid, ...], foam: Foam
    ) -> None:
        self.z_m = pose.z_m
        self.swell_m = 0.0
        self._foam = foam
        self._grids = grids
        tables: list[ForceTable] = []
        shares: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
        lags_m: list[NDArray[np.float64]] = []
        seen: PadGrid | None = None
        for side, grid in enumerate(grids):
            if seen is None or not grid.same_points_as(seen):
                heights_m = posed_heights(shape, pose, *np.broadcast_arrays(grid.x_m, grid.y_m))
                seen = grid
            reach_m = heights_m[side]
            covered: NDArray[np.bool_] = np.isfinite(reach_m)
            if not covered.any():
                raise SimulatorSettingsError(
                    f"at x = {1e3 * pose.x_m:.1f} mm, y = {1e3 * pose.y_m:.1f} mm the object lies "
                    f"beside the pad {grid.pad.name}"
                )
            window = (_span(covered, axis=0), _span(covered, axis=1))
            table = ForceTable(foam, reach_m[window], grid.cell_area_m2)
            tables.append(table)
            shares.append(grid.shares(window))
            lags_m.append(table.reach_max_m - reach_m[window])
        self._tables = (tables[0], tables[1])
        self._shares = shares
        self._lag_m = lags_m

    @property
    def reach_m(self) -> tuple[float, float]:
        """How far the object reaches from its centre towards finger 0 and finger 1 in m."""
        return self._tables[0].reach_max_m, self._tables[1].reach_max_m

    def _depths_m(self, position_m: tuple[float, float]) -> tuple[float, float]:
        near, far = self._tables
        return (
            near.reach_max_m + self.swell_m - self.z_m - position_m[0],
            far.reach_max_m + self.swell_m + self.z_m - position_m[1],
        )

    def settle(
        self, position_m: tuple[float, float], friction_n: float
    ) -> tuple[tuple[float, float], tuple[float, float]]:
        """Let the object float to where the pads and its nest hold it.

        It stays where it is while the pads' forces differ by no more than the nest's friction;
        else it moves until they do.

        Parameters
        ----------
        position_m
            Half openings of finger 0 and finger 1 in m.
        friction_n
            Friction of the nest in N.

        Returns
        -------
        force_n, stiffness_n_m
            Force on each pad in N, and how fast each falls as its finger opens, in N/m.
        """
        near, far = self._tables
        depth_0, depth_1 = self._depths_m(position_m)
        if depth_0 <= 0.0 and depth_1 <= 0.0:
            return (0.0, 0.0), (0.0, 0.0)
        force_0, slope_0 = near.lookup(depth_0)
        force_1, slope_1 = far.lookup(depth_1)
        net_n = force_0 - force_1
        if abs(net_n) > friction_n:
            goal_n = math.copysign(friction_n, net_n)
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
        pressure_pa = self._foam.pressure_pa(depth_m - self._lag_m[side])
        return self._grids[side].taxel_force_n(pressure_pa, self._shares[side])


def _span(covered: NDArray[np.bool_], *, axis: int) -> slice:
    """Return the stretch along an axis in which something is covered."""
    indices = np.nonzero(covered)[axis]
    return slice(int(indices.min()), int(indices.max()) + 1)
