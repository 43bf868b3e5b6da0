"""Virtual grasps: readings that a taught grasp would have given in another, equivalent pose.

Turned by 180 degrees an object offers the same two surfaces to the same two pads. About the finger
it changes sides, and each pad sees what the other one saw. About the closing direction it stays on
its pad and the patch turns. Both need pads that are alike and evenly spaced; nothing is invented
for other pads. A tilt turns each patch by a few degrees, as the next pose may.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from recognition.features.footprint import PadGrid
from recognition.ramp.levels import Levels

TILTS_RAD = (-np.pi / 12, np.pi / 12)
"""Tilts in rad, 15 degrees either way: the next pose of an object may differ by as much."""

_SAME_MM = 1e-3
"""Difference in mm up to which two pitches count as equal."""


def can_change_sides(grids: Sequence[PadGrid]) -> bool:
    """Return whether two pads are alike, so that an object may change sides."""
    return len(grids) == 2 and (
        grids[0].shape == grids[1].shape
        and bool(np.allclose(grids[0].pitch_mm, grids[1].pitch_mm, atol=_SAME_MM))
    )


def change_sides(levels: Levels) -> Levels:
    """Return the grasps as if each object had changed sides: the pads change places."""
    return replace(
        levels,
        maps=levels.maps[::-1],
        noise=levels.noise[..., ::-1],
        touch_aperture_mm=levels.touch_aperture_mm[:, ::-1],
        timed_load=levels.timed_load[:, ::-1],
        touch_delay_s=-levels.touch_delay_s,
    )


def turn(levels: Levels) -> Levels:
    """Return the grasps as if each object had been turned by 180 degrees about the closing axis.

    Taxels are row-major on a grid that is the same both ways round, so the order is reversed.
    """
    return replace(levels, maps=tuple(m[..., ::-1] for m in levels.maps))


def tilt(levels: Levels, grids: Sequence[PadGrid], angle_rad: float) -> Levels:
    """Return the grasps as if each patch had been turned about the centre of its load.

    Between taxels the pressure is taken as linear; what is turned off the pad is lost.
    """
    maps = tuple(_turned(m, g, angle_rad) for m, g in zip(levels.maps, grids, strict=True))
    before, after = (
        np.stack([m[:, -1].sum(axis=1) for m in of_pads], axis=1) for of_pads in (levels.maps, maps)
    )
    kept = np.where(before > 0, after / np.where(before > 0, before, 1.0), 1.0)
    return replace(levels, maps=maps, timed_load=levels.timed_load * kept[..., None])


def _turned(maps: NDArray[np.float64], grid: PadGrid, angle_rad: float) -> NDArray[np.float64]:
    """Return maps (n, K, n_taxels) turned about their centres of load."""
    n_maps = maps.shape[0] * maps.shape[1]
    pressure = maps.reshape(n_maps, -1)
    rows, columns = np.divmod(np.arange(pressure.shape[1]), grid.shape[1])
    # One step along a row and along a column of taxels, in mm: from the positions, as pads are
    # laid out in different ways.
    steps, *_ = np.linalg.lstsq(
        np.column_stack([rows, columns, np.ones_like(rows)]), grid.xy_mm, rcond=None
    )
    load = np.maximum(pressure, 0.0)
    centre = load @ grid.xy_mm / np.maximum(load.sum(axis=1), 1e-9)[:, None]
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    back = np.array([[cosine, -sine], [sine, cosine]])
    source = centre[:, None] + (grid.xy_mm - centre[:, None]) @ back
    index = (source - steps[2]) @ np.linalg.pinv(steps[:2])
    number = np.broadcast_to(np.arange(n_maps, dtype=np.float64)[:, None], index.shape[:2])
    turned = map_coordinates(
        pressure.reshape(n_maps, *grid.shape),
        [number, index[..., 0], index[..., 1]],
        order=1,
        mode="grid-constant",
    )
    return np.asarray(turned.reshape(maps.shape), dtype=np.float64)
