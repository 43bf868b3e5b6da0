"""Limits of the numbers and texts of grasps, for files of every format."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.recognizer import UNKNOWN

MAX_TEXT = 200
"""Most characters of a text of a grasp."""
RANGES = {
    "adc_max": (1, 65535, "counts have 16 bits"),
    "pad_shape": (1, 1000, "rows and columns of a pad"),
    "taxel_pad": (0, 255, "pads are numbered from 0"),
    "taxel_xy_m": (-1.0, 1.0, "places stand in m"),
    "aperture_m": (-0.1, 1.0, "openings stand in m"),
    "force_n": (-100.0, 10_000.0, "grip forces stand in N"),
    "thickness_m": (0.0, 1.0, "thicknesses stand in m"),
    "command": (-0.5, 0.5, "offsets stand in m"),
    "start_ms": (-1e15, 1e15, "times stand in ms since 1970"),
}
"""Smallest and largest number of an array, and its unit: far beyond any gripper, but close
enough to detect a wrong unit, a factor of 1000."""

FRAME_PERIOD_S = (1e-5, 2.0)
"""Shortest and longest mean period of a grasp's frames."""


def check_range(name: str, values: NDArray[Any]) -> None:
    """Raise ValueError for a number of an array beyond its range; NaN is allowed."""
    low, high, unit = RANGES[name]
    flat = values.ravel()
    beyond = np.flatnonzero((flat < low) | (flat > high))
    if beyond.size:
        where = int(beyond[0])
        raise ValueError(
            f"{name} is {flat[where]:g} at {where}, must be from {low:g} to {high:g}: {unit}"
        )


def check_text(name: str, text: str) -> None:
    """Raise ValueError for a text of a grasp, e.g. its label, that no file may have."""
    if not text.isprintable() or len(text) > MAX_TEXT:
        raise ValueError(
            f"{name} is {text!a:.60}: not printable, or longer than {MAX_TEXT} characters"
        )
    if name == "label" and text == UNKNOWN:
        raise ValueError(
            f"label is {UNKNOWN}, the answer for untaught objects: write a name, or leave it empty"
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
