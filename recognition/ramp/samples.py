"""Invalid samples: spikes of single frames, and stuck taxels."""

import numpy as np
from numpy.typing import NDArray

QUIET_FRAMES = 3
"""Frames at the start of a grasp in which the pads count as untouched, if their load is small."""

_STARTS_TOUCHED = 0.25
"""Share of a pad's largest load above which its first frames count as loaded."""

_SPIKE_SHARE = 0.2
"""Share of full scale by which a spike exceeds both neighbouring frames; a ramp rises by less."""

_STUCK_SHARE = 0.02
"""Least difference of a stuck taxel from its rest, as a share of full scale."""

_STUCK_SIGMAS = 6.0
"""The same in standard deviations of the noise, more than noise alone reaches."""


def without_spikes(counts: NDArray[np.float64], adc_max: int) -> NDArray[np.float64]:
    """Replace spikes with the mean of the frames before and after.

    Parameters
    ----------
    counts : (n_frames, n_taxels)
        Readings of one pad.
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
    """Return which taxels never change and differ from rest by more than a common drift.

    Parameters
    ----------
    counts : (n_frames, n_taxels)
        Readings of one pad.
    taught : (n_taxels,)
        Untouched reading of each taxel in counts, from teaching.
    noise
        Standard deviation of one sample in counts.
    """
    change = counts[0] - taught
    change = np.abs(change - np.median(change))
    still = np.ptp(counts, axis=0) == 0.0
    limit = max(_STUCK_SIGMAS * noise, _STUCK_SHARE * adc_max)
    stuck: NDArray[np.bool_] = still & (change > limit)
    if stuck.any():
        # A constant load does not change either. It shows as no load on the other taxels.
        _, largest = _first_and_largest(counts, taught, stuck)
        if largest < limit or starts_loaded(counts, taught, stuck):
            stuck[:] = False
    return stuck


def starts_loaded(
    counts: NDArray[np.float64], taught: NDArray[np.float64], stuck: NDArray[np.bool_]
) -> bool:
    """Return whether a pad is loaded in its first frames, or has too few frames."""
    first, largest = _first_and_largest(counts, taught, stuck)
    return len(counts) < 2 * QUIET_FRAMES or first > _STARTS_TOUCHED * largest


def _first_and_largest(
    counts: NDArray[np.float64], taught: NDArray[np.float64], stuck: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the load of the first frames and the largest one, in counts of all taxels."""
    start = counts[:QUIET_FRAMES].mean(axis=0) - taught
    # A drift changes all taxels, an object presses some: a common change is not a load.
    totals = (counts - taught - float(np.median(start)))[:, ~stuck].sum(axis=1)
    return float(totals[:QUIET_FRAMES].mean()), float(totals.max())


def with_stuck_replaced(
    rise: NDArray[np.float64], stuck: NDArray[np.bool_], shape: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the rise with each stuck taxel replaced by the mean of its sound neighbours.

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
    replaced = rise.copy()
    for taxel in np.flatnonzero(stuck):
        row, column = divmod(int(taxel), columns)
        beside = [
            r * columns + c
            for r, c in ((row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1))
            if 0 <= r < rows and 0 <= c < columns and not stuck[r * columns + c]
        ]
        replaced[:, taxel] = rise[:, beside].mean(axis=1) if beside else 0.0
    return replaced
