"""Virtual grasps: what a taught grasp would have shown in a pose that changes nothing else.

Turned by 180 degrees an object offers the same two surfaces to the same two pads. About the finger
it changes sides, and each pad sees what the other one saw. About the closing direction it stays on
its pad and the patch turns. Both need pads that are alike and evenly spaced; nothing is invented
for other pads.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from recognition.features_footprint import PadGrid
from recognition.ramp_levels import Levels

_SAME_MM = 1e-3


def can_change_sides(grids: Sequence[PadGrid]) -> bool:
    """Say whether two pads are alike, so that an object may change sides."""
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
