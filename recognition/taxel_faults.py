"""Samples that no load explains: spikes of single frames, and taxels that are stuck."""

import numpy as np
from numpy.typing import NDArray

QUIET_FRAMES = 3
"""Number of frames at the start of a grasp that tell whether the pads are untouched."""

_STARTS_TOUCHED = 0.25
_SPIKE_SHARE = 0.2
_STUCK_SHARE = 0.02
_STUCK_SIGMAS = 6.0


def without_spikes(counts: NDArray[np.float64], adc_max: int) -> NDArray[np.float64]:
    """Replace samples that stand far out from the frames before and after: no load does that.

    Parameters
    ----------
    counts : (n_frames, n_taxels)
        Readings of one pad.
    adc_max
        Full scale of the counts.
    """
    before, here, after = counts[:-2], counts[1:-1], counts[2:]
    limit = _SPIKE_SHARE * adc_max
    above = here - np.maximum(before, after) > limit
    below = np.minimum(before, after) - here > limit
    if not (above.any() or below.any()):
        return counts
    cleaned = counts.copy()
    cleaned[1:-1] = np.where(above | below, 0.5 * (before + after), here)
    return cleaned


def stuck_taxels(
    counts: NDArray[np.float64], taught: NDArray[np.float64], noise: float, adc_max: int
) -> NDArray[np.bool_]:
    """Say which taxels never change and read what neither rest nor a common drift explains.

    Parameters
    ----------
    counts : (n_frames, n_taxels)
        Readings of one pad.
    taught : (n_taxels,)
        What they read untouched when they were taught.
    noise
        Standard deviation of one sample in counts.
    adc_max
        Full scale of the counts.
    """
    change = counts[0] - taught
    change = np.abs(change - np.median(change))
    still = np.ptp(counts, axis=0) == 0.0
    limit = max(_STUCK_SIGMAS * noise, _STUCK_SHARE * adc_max)
    stuck: NDArray[np.bool_] = still & (change > limit)
    if stuck.any():
        # A load that is held all the time does not change either: then the others show none.
        _, largest = _first_and_largest(counts, taught, stuck)
        if largest < limit or starts_loaded(counts, taught, stuck):
            stuck[:] = False
    return stuck


def starts_loaded(
    counts: NDArray[np.float64], taught: NDArray[np.float64], stuck: NDArray[np.bool_]
) -> bool:
    """Say whether the first frames of a pad are loaded already, or too few to tell."""
    first, largest = _first_and_largest(counts, taught, stuck)
    return len(counts) < 2 * QUIET_FRAMES or first > _STARTS_TOUCHED * largest


def _first_and_largest(
    counts: NDArray[np.float64], taught: NDArray[np.float64], stuck: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the load of the first frames and the largest one, in counts of all taxels."""
    start = counts[:QUIET_FRAMES].mean(axis=0) - taught
    # A drift moves all taxels, an object presses some: what most share is no load.
    totals = (counts - taught - float(np.median(start)))[:, ~stuck].sum(axis=1)
    return float(totals[:QUIET_FRAMES].mean()), float(totals.max())


def mended(
    rise: NDArray[np.float64], stuck: NDArray[np.bool_], shape: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Give stuck taxels the mean of those next to them that are not.

    Parameters
    ----------
    rise : (n_frames, n_taxels)
        Counts above rest of one pad.
    stuck : (n_taxels,)
        Which taxels are stuck.
    shape : (2,)
        Rows and columns of the pad.
    """
    if not stuck.any():
        return rise
    rows, columns = (int(n) for n in shape)
    mended = rise.copy()
    for taxel in np.flatnonzero(stuck):
        row, column = divmod(int(taxel), columns)
        beside = [
            r * columns + c
            for r, c in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
            if 0 <= r < rows and 0 <= c < columns and not stuck[r * columns + c]
        ]
        mended[:, taxel] = rise[:, beside].mean(axis=1) if beside else 0.0
    return mended
