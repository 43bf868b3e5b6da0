"""Limits of the numbers of grasps, for files of every format."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray

RANGES = {
    "adc_max": (1, 65535, "counts have 16 bits"),
    "pad_shape": (1, 1000, "rows and columns of a pad"),
    "taxel_pad": (0, 255, "pads are numbered from 0"),
    "taxel_xy_m": (-1.0, 1.0, "places of taxels"),
    "aperture_m": (-0.1, 1.0, "openings"),
    "force_n": (-100.0, 10_000.0, "grip forces in N"),
    "thickness_m": (0.0, 1.0, "thicknesses"),
    "command": (-0.5, 0.5, "offsets in m"),
    "start_ms": (-1e15, 1e15, "times in ms since 1970"),
}
"""Smallest and largest number of an array in SI units, and its meaning: far beyond any gripper, but
close enough to detect a wrong unit, a factor of 1000."""
LEAST_OPENING_M, LEAST_PAD_M = 2e-4, 1e-4
"""Least opening in m that each data set reaches, at the latest before a contact, and least extent
in m of a pad with several taxels."""

FRAME_PERIOD_S = (1e-5, 2.0)
"""Shortest and longest mean period of a grasp's frames."""


def check_range(name: str, values: NDArray[Any], stored: str = "", unit: float = 1.0) -> None:
    """Raise ValueError for a number of an array beyond its range; NaN is allowed.

    ``stored``, ``unit``: name and unit of the array in its file, if they differ.
    """
    low, high, meaning = RANGES[name]
    low, high = unit * low, unit * high
    flat = values.ravel()
    beyond = np.flatnonzero((flat < low) | (flat > high))
    if beyond.size:
        where = int(beyond[0])
        raise ValueError(
            f"{stored or name} is {flat[where]:g} at {where}, must be from {low:g} to {high:g}: "
            f"{meaning}{' in mm' if unit == 1e3 else ''}"
        )


def check_sizes(pads: PadArray, aperture_m: NDArray[np.float64]) -> None:
    """Raise ValueError for openings or pads that are too small: written in m, not in mm."""
    known_m = aperture_m[~np.isnan(aperture_m)]
    if known_m.size and known_m.max() < LEAST_OPENING_M:
        raise ValueError(
            f"the largest aperture_mm is {1e3 * known_m.max():g}, expected "
            f"{1e3 * LEAST_OPENING_M:g} or more: write openings in mm, not in m; NaN if unknown"
        )
    for pad in range(len(pads.pad_shape)):
        places_m = pads.taxel_xy_m[pads.taxel_pad == pad]
        if len(places_m) > 1 and (extent_m := np.ptp(places_m, axis=0).max()) < LEAST_PAD_M:
            raise ValueError(
                f"taxel_xy_mm spreads the {len(places_m)} taxels of pad {pad} over "
                f"{1e3 * extent_m:g}, expected {1e3 * LEAST_PAD_M:g} or more: places stand in mm, "
                "not in m"
            )


def check_times(t_s: NDArray[np.float64], offsets: NDArray[np.int64]) -> None:
    """Raise ValueError for times of frames that no grasp has.

    Times (n_frames,) in s count from the first frame of each grasp; offsets (n_grasps + 1,) are the
    number of that frame, and the end.
    """
    falls = np.flatnonzero(~(np.diff(t_s) >= 0)) + 1  # NaN counts as a fall
    if np.any(t_s[offsets[:-1]] != 0) or not np.all(np.isin(falls, offsets)):
        raise ValueError("t_s must start at 0 in each grasp and never fall within one")
    steps = np.diff(offsets) - 1
    several = np.flatnonzero(steps > 0)
    period_s = t_s[offsets[1:] - 1][several] / steps[several]
    shortest_s, longest_s = FRAME_PERIOD_S
    ill = np.flatnonzero((period_s < shortest_s) | (period_s > longest_s))
    if ill.size:
        raise ValueError(
            f"t_s has a frame each {period_s[ill[0]]:g} s in the mean of grasp {several[ill[0]]}, "
            f"expected {shortest_s:g} to {longest_s:g} s: times stand in s since the grasp's first "
            "frame"
        )
