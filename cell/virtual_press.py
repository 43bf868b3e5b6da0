"""A drawn surface pressed into a pad: force over depth, on the pad and on each taxel."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.pose import Pose
from recognition.drawing import Drawing, posed, resting_roll_rad
from recognition.foam_model import FoamModel, PadBed
from recognition.foam_sideways import closed_columns_m, neighbours

_DEEPEST = 0.97
_N_DEPTHS = 48
_FEW_DEPTHS = 20
_STEPS = 6
_FAR_M = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Press:
    """One pad pressed by one surface, over the depth of its highest point.

    Attributes
    ----------
    reach_max_m
        Highest point of the surface above the middle plane in m.
    depth_m : (k,) float64
        Depths of the highest point in m, evenly spaced from 0.
    force_n : (k,) float64
        Force on the pad in N.
    taxels_n : (k, n_taxels) float64
        Force on each taxel in N.
    """

    reach_max_m: float
    depth_m: NDArray[np.float64]
    force_n: NDArray[np.float64]
    taxels_n: NDArray[np.float64]

    def taxel_force_n(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return forces (n, n_taxels) in N at depths (n,) in m."""
        place = np.clip(depth_m / self.depth_m[1], 0.0, len(self.depth_m) - 1.0)
        below = np.minimum(place.astype(np.int64), len(self.depth_m) - 2)
        share = (place - below)[:, None]
        low_n, high_n = self.taxels_n[below], self.taxels_n[below + 1]
        force_n: NDArray[np.float64] = low_n + share * (high_n - low_n)
        return force_n


def reaches_m(
    drawing: Drawing,
    pose: Pose,
    beds: Sequence[PadBed],
    aslant_rad: NDArray[np.float64] | None = None,
) -> list[NDArray[np.float64]]:
    """Return how far a posed object reaches towards each pad in m, over the grids of the pads.

    Tilted by the small angles ``aslant_rad`` (2,) it reaches as much further towards one pad as
    less far towards the other, in proportion to the way from its centre along x and along y.

    Raises ValueError where it lies beside a pad.
    """
    both: list[NDArray[np.float64]] = []
    for side, bed in enumerate(beds):
        if side == 0 or not bed.same_points_as(beds[0]):
            heights_m = posed(
                drawing,
                bed.x_m,
                bed.y_m,
                at_m=(pose.x_m, pose.y_m),
                rotation_rad=pose.rotation_rad,
                roll_rad=resting_roll_rad(drawing, pose.roll_rad),
            )
        if not np.isfinite(heights_m[side]).any():
            raise ValueError(f"the object lies beside the pads at {pose}")
        if aslant_rad is None:
            both.append(heights_m[side])
        else:
            lever_m = aslant_rad[0] * (bed.x_m - pose.x_m) + aslant_rad[1] * (bed.y_m - pose.y_m)
            both.append(heights_m[side] + (lever_m if side == 0 else -lever_m))
    return both


def press(bed: PadBed, reach_m: NDArray[np.float64], foam: FoamModel) -> Press:
    """Work out what a surface does to a pad, from the first touch to almost flat foam."""
    highest_m = float(reach_m.max())
    lag_m = np.where(np.isfinite(reach_m), highest_m - reach_m, np.inf)
    near = lag_m < foam.thickness_m
    rows, columns = np.flatnonzero(near.any(axis=1)), np.flatnonzero(near.any(axis=0))
    part = np.ix_(rows, columns)
    n_depths = _FEW_DEPTHS if foam.sideways else _N_DEPTHS
    depth_m = np.linspace(0.0, _DEEPEST * foam.thickness_m, n_depths)
    closed_m: NDArray[np.floating[Any]] = depth_m[:, None, None] - lag_m[part]
    if foam.sideways:
        wanted_m = np.maximum(closed_m, -_FAR_M).astype(np.float32)
        pushes = (
            neighbours(bed.x_m[rows, 0], foam.sideways_m).astype(np.float32),
            neighbours(bed.y_m[0, columns], foam.sideways_m).astype(np.float32),
        )
        closed_m = closed_columns_m(wanted_m, 1.0, foam.sideways, pushes, steps=_STEPS)
    pressure_pa = foam.modulus_pa * foam.relative_pressure(closed_m)
    taxels_n = bed.along[:, rows] @ (pressure_pa @ bed.across[:, columns].T) * bed.cell_area_m2
    taxels_n = taxels_n.reshape(n_depths, -1)
    return Press(
        reach_max_m=highest_m, depth_m=depth_m, force_n=taxels_n.sum(axis=1), taxels_n=taxels_n
    )


def shared_force(presses: Sequence[Press], depth_sum_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the force in N at which both pads together are so deep: the object floats."""
    force_n = np.linspace(0.0, min(float(p.force_n[-1]) for p in presses), 4 * _N_DEPTHS)
    together_m = sum(np.interp(force_n, p.force_n, p.depth_m) for p in presses)
    shared_n: NDArray[np.float64] = np.interp(depth_sum_m, np.asarray(together_m), force_n)
    return shared_n
