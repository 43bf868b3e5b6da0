"""Numbers that a grasp cannot have: what a file holds in metres, ms or another unit by mistake.

Each function returns what is wrong with an array, for the message of its reader; None for nothing.
The limits are far from any gripper's numbers and near enough to see a factor of 1000.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray

RANGES = {
    "aperture_mm": (-100.0, 1000.0, "openings stand in mm"),
    "force_n": (-100.0, 10_000.0, "grip forces stand in N"),
    "taxel_xy_mm": (-1000.0, 1000.0, "places stand in mm"),
    "pose": (-0.5, 0.5, "offsets stand in m"),
    "start_ms": (-1e15, 1e15, "times stand in ms since 1970"),
}
"""Smallest and largest number of an array, and its unit."""

LEAST_OPENING_MM = 0.2
"""No fingers stay below it in all grasps of a data set, rest before the contact included."""
LEAST_PAD_MM = 0.1
"""No pad of several taxels is smaller."""
FRAME_PERIOD_S = (1e-5, 2.0)
"""Shortest and longest mean period of a grasp's frames."""


def beyond_range(name: str, values: NDArray[Any]) -> str | None:
    """Say which number of an array is beyond its range; NaN is within."""
    low, high, unit = RANGES[name]
    flat = values.ravel()
    beyond = np.flatnonzero((flat < low) | (flat > high))
    if not beyond.size:
        return None
    where = int(beyond[0])
    return f"is {flat[where]:g} at {where}, must be from {low:g} to {high:g}: {unit}"


def openings_too_small(aperture_mm: NDArray[np.float64]) -> str | None:
    """Say that fingers never open as far as any do; unknown openings are none."""
    known = aperture_mm[~np.isnan(aperture_mm)]
    if not known.size or known.max() >= LEAST_OPENING_MM:
        return None
    return (
        f"never exceeds {known.max():g}, expected {LEAST_OPENING_MM:g} or more somewhere: openings "
        "stand in mm, not in m; write NaN where they are unknown"
    )


def pads_too_small(pads: PadArray) -> str | None:
    """Say which pad has all its taxels in one place."""
    for pad in range(len(pads.pad_shape)):
        places_mm = pads.taxel_xy_m[pads.taxel_pad == pad] * 1e3
        extent_mm = float(np.ptp(places_mm, axis=0).max())
        if len(places_mm) > 1 and extent_mm < LEAST_PAD_MM:
            return (
                f"spreads the {len(places_mm)} taxels of pad {pad} over {extent_mm:g}, expected "
                f"{LEAST_PAD_MM:g} or more: places stand in mm, not in m"
            )
    return None


def frames_ill_timed(t_s: NDArray[np.float64], offsets: NDArray[np.int64]) -> str | None:
    """Say which grasp's frames follow each other faster or slower than any sensor's.

    Parameters
    ----------
    t_s
        Time (n_frames,) since the first frame of each grasp in s.
    offsets
        First frame (n_grasps + 1,) of each grasp, and the end.
    """
    steps = np.diff(offsets) - 1
    several = np.flatnonzero(steps > 0)
    period_s = t_s[offsets[1:] - 1][several] / steps[several]
    shortest_s, longest_s = FRAME_PERIOD_S
    ill = np.flatnonzero((period_s < shortest_s) | (period_s > longest_s))
    if not ill.size:
        return None
    grasp, found_s = int(several[ill[0]]), float(period_s[ill[0]])
    return (
        f"has a frame each {found_s:g} s in the mean of grasp {grasp}, expected {shortest_s:g} to "
        f"{longest_s:g} s: times stand in s since the grasp's first frame"
    )
