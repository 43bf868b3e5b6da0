"""Contact patch of a pad: baseline, noise, connected loaded taxels.

Heights are counts by default, because the paper's surface has heights in 8-bit counts. Its numbers
show this: the smallest eigenvalue is of the order of 1e-3, the largest of 1e2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from recognition.errors import ContactError
from recognition.grasp import Grasp, PadArray, keep_array

MIN_QUIET_FRAMES = 3
"""Fewest frames before contact for a baseline of each taxel."""
_QUANTISATION_COUNTS = 0.289
"""Standard deviation of rounding to whole counts: 1 / sqrt(12)."""
_MAD_TO_SD = 1.4826
"""Standard deviation over median absolute deviation of a normal distribution."""
_QUIET_SIGMAS = 5.0
"""Largest excess of a pad's total over its least value before contact, in standard deviations."""
_QUIET_SCALE = 0.002
"""The same as a share of one taxel's full scale, added to the noise."""
_LOADED_SIGMAS = 4.0
"""Threshold of a loaded taxel in standard deviations of the mean."""
_LEAST_HEIGHT = 0.004
"""Least height of a loaded taxel as a share of full scale: one count of 255."""
_NEIGHBOURS = np.ones((3, 3), dtype=np.int64)
"""Neighbours, also over a corner, are connected."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Baseline:
    """Readings of the untouched pads in one grasp, and their noise."""

    counts: NDArray[np.float64]
    """(n_taxels,) float64: reading of each taxel without load."""
    noise_counts: NDArray[np.float64]
    """(n_pads,) float64: robust standard deviation of one taxel in one frame, for each pad."""
    quiet_frames: NDArray[np.int64]
    """(n_pads,) int64: frames before contact that give the baseline. It is 0 if there are too few;
    the median of the pad's first frame is then used for all its taxels."""

    def __post_init__(self) -> None:
        for name in ("counts", "noise_counts", "quiet_frames"):
            keep_array(self, name, getattr(self, name))


def robust_noise(values: ArrayLike) -> float:
    """Return 1.4826 times the median absolute deviation, never below that of rounding."""
    values = np.asarray(values, dtype=np.float64)
    if values.size == 0:
        return _QUANTISATION_COUNTS
    spread = float(np.median(np.abs(values - np.median(values))))
    return max(_MAD_TO_SD * spread, _QUANTISATION_COUNTS)


def estimate_baseline(grasp: Grasp) -> Baseline:
    """Return baseline and noise of each pad from the frames of one grasp.

    Frames before contact are the first ones, while a pad's total stays within the noise of its
    least value among them. A known commanded force ends them before it rises above 0, because the
    noise of a whole pad hides the first touched taxels. The noise is that of the differences
    between frames, which the slow rise of a ramp hardly changes. With one frame it is the spread
    over the pad.

    Parameters
    ----------
    grasp
        A force ramp, from the open gripper on.
    """
    pads = grasp.pads
    baseline = np.empty(pads.n_taxels)
    noise = np.empty(pads.n_pads)
    quiet = np.zeros(pads.n_pads, dtype=np.int64)
    forced = np.flatnonzero(grasp.force_n > 0.0)
    known = len(forced) and forced[0] >= MIN_QUIET_FRAMES
    unforced = int(forced[0]) if known else grasp.n_frames
    for pad in range(pads.n_pads):
        taxels = pads.taxels_of(pad)
        counts = grasp.counts[:, taxels].astype(np.float64)
        if len(counts) > 1:
            noise[pad] = robust_noise(np.diff(counts, axis=0)) / np.sqrt(2.0)
            noise[pad] = max(noise[pad], _QUANTISATION_COUNTS)
        else:
            noise[pad] = robust_noise(counts)
        limit = _QUIET_SIGMAS * noise[pad] * np.sqrt(len(taxels)) + _QUIET_SCALE * pads.adc_max
        n_quiet = min(_quiet_frames(counts.sum(axis=1), limit), unforced)
        if n_quiet >= MIN_QUIET_FRAMES:
            quiet[pad] = n_quiet
            baseline[taxels] = np.mean(counts[:n_quiet], axis=0)
        else:
            baseline[taxels] = np.median(counts[0])
    return Baseline(counts=baseline, noise_counts=noise, quiet_frames=quiet)


def _quiet_frames(total: NDArray[np.float64], limit: float) -> int:
    """Count the leading frames whose total is within ``limit`` of the least total so far."""
    least = np.minimum.accumulate(total)
    loud = np.flatnonzero(total - least > limit)
    n_quiet = int(loud[0]) if len(loud) else len(total)
    # A ramp that is steeper than the noise shows in its first step. The last quiet frame may
    # already show the object, so it is left out before a contact.
    return n_quiet - 1 if len(loud) and n_quiet > MIN_QUIET_FRAMES else n_quiet


def noise_threshold(noise_counts: float, n_averaged: int, adc_max: int) -> float:
    """Return the height in counts that a taxel must exceed to be loaded.

    Parameters
    ----------
    noise_counts
        Standard deviation of one taxel in one frame.
    n_averaged
        Number of averaged frames.
    adc_max
        Full scale; the threshold is never below 0.4 % of it (one count of 255).
    """
    return max(_LOADED_SIGMAS * noise_counts / float(np.sqrt(n_averaged)), _LEAST_HEIGHT * adc_max)


def main_patch(
    height: NDArray[np.float64], pads: PadArray, pad: int, threshold: float, *, rim: int = 0
) -> NDArray[np.int64]:
    """Return the taxels of the most loaded patch of a pad, indices among all, ascending.

    Raises ContactError if no taxel exceeds the threshold; the message names the largest height.

    Parameters
    ----------
    height : (n_taxels,) float64
        Baseline-corrected counts of all taxels.
    pads, pad
        Positions of the taxels, and number of the pad.
    threshold
        Taxels above it are loaded; neighbours, also over a corner, make one patch.
    rim
        Rings of taxels around each patch that are added with their own heights. They show the end
        of the contact; without them small contacts have no surface.
    """
    taxels = pads.taxels_of(pad)
    grid = height[taxels].reshape(pads.pad_shape[pad])
    loaded = grid > threshold
    label, n_patches = ndimage.label(loaded, structure=_NEIGHBOURS)
    if not n_patches:
        raise ContactError(
            f"pad {pad} is not touched: largest height {float(grid.max()):.3g} counts, threshold "
            f"{threshold:.3g}; grip harder or tare again"
        )
    patches = []
    for index in range(1, n_patches + 1):
        core = label == index
        wide = ndimage.binary_dilation(core, _NEIGHBOURS, iterations=rim) if rim else core
        patches.append(taxels[np.flatnonzero((core | (wide & ~loaded)).ravel())])
    return max(patches, key=lambda patch: float(height[patch].sum()))
