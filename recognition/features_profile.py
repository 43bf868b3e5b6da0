"""Load along and across the finger: once as it lies on the pad, once centred on the patch."""

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid, pressed

_MIN_LOAD = 0.01


def profile_features(
    maps: NDArray[np.float64], noise: NDArray[np.float64], grid: PadGrid
) -> NDArray[np.float64]:
    """Return (n, F): roots of the shares of load per row and column at the last level.

    Parameters
    ----------
    maps : (n, K, n_taxels)
        Values above rest, as a fraction of full scale.
    noise : (n, K)
        Standard deviation of each value.
    grid
        The pad.
    """
    patch = pressed(maps[:, -1], noise[:, -1]).reshape(len(maps), *grid.shape)
    load = np.maximum(patch.sum(axis=(1, 2)), _MIN_LOAD)[:, None]
    parts: list[NDArray[np.float64]] = []
    for other_axis in (2, 1):
        share = patch.sum(axis=other_axis) / load
        parts += [np.sqrt(share), np.sqrt(_centred(share))]
    return np.concatenate(parts, axis=1)


def _centred(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift each row so that its centre of mass comes to the middle; linear between neighbours."""
    n, length = share.shape
    reach = (length + 1) // 3 + 1
    centre = share @ np.arange(length) / np.maximum(share.sum(axis=1), 1e-9)
    position = centre[:, None] + np.arange(-reach, reach + 1)
    left = np.floor(position).astype(np.int64)
    part = position - left
    padded = np.pad(share, ((0, 0), (length, length)))
    rows = np.arange(n)[:, None]
    at_left, at_right = padded[rows, left + length], padded[rows, left + length + 1]
    moved: NDArray[np.float64] = at_left * (1.0 - part) + at_right * part
    return moved
