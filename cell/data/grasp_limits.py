"""Limits of grasps: numbers and texts that no file of grasps may have, whatever its format."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray
from recognition.recognizer import UNKNOWN

MAX_TEXT = 200
"""Characters of a text of a grasp."""
RANGES = {
    "aperture_mm": (-100.0, 1000.0, "openings stand in mm"),
    "force_n": (-100.0, 10_000.0, "grip forces stand in N"),
    "taxel_xy_mm": (-1000.0, 1000.0, "places stand in mm"),
    "thickness_mm": (0.0, 1000.0, "thicknesses stand in mm"),
    "pose": (-0.5, 0.5, "offsets stand in m"),
    "start_ms": (-1e15, 1e15, "times stand in ms since 1970"),
}
"""Smallest and largest number of an array, and its unit: far from any gripper's numbers, and near
enough to show a wrong unit, a factor of 1000."""

LEAST_OPENING_MM = 0.2
"""No fingers stay below it in all grasps of a data set, rest before the contact included."""
LEAST_PAD_MM = 0.1
"""No pad of several taxels is smaller."""
FRAME_PERIOD_S = (1e-5, 2.0)
"""Shortest and longest mean period of a grasp's frames."""


def beyond_range(name: str, values: NDArray[Any]) -> str | None:
    """Return which number of an array is beyond its range, None if none is; NaN is within."""
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


def text_refused(name: str, text: str) -> str | None:
    """Return why a text of a grasp, as its label, is refused; None where it is not."""
    if not text.isprintable() or len(text) > MAX_TEXT:
        return f"is {text!a:.60}: not printable, or longer than {MAX_TEXT} characters"
    if name == "label" and text == UNKNOWN:
        return f"is {UNKNOWN}, the answer for what was not taught: write a name, or leave it empty"
    return None


def times_refused(t_s: NDArray[np.float64], offsets: NDArray[np.int64]) -> str | None:
    """Return why the times of frames are refused; None where they are not.

    Times (n_frames,) in s count from the first frame of each grasp; offsets (n_grasps + 1,) are its
    number, and the end.
    """
    falls = np.flatnonzero(~(np.diff(t_s) >= 0)) + 1  # a time that is no number falls, too
    if np.any(t_s[offsets[:-1]] != 0) or not np.all(np.isin(falls, offsets)):
        return "must start at 0 in each grasp and never fall within one"
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
