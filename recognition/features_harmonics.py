"""What the patch looks like close up: how strongly small circular harmonics answer to it.

A circular harmonic is a bump, or a wave with a number of crests around a centre, under a Gaussian
window (Freeman and Adelson 1991 steer such filters). Laid over each place of the pad it answers the
more, the more the pressure there looks like it. The strongest answer and the energy of all of them
do not change when the patch moves or turns, taxels being fine enough, and need no centre of the
patch, which the rim of the pad may have cut off. What is looked at is the root of the density of
load, a unit of energy in all, so no gain changes them either.
"""

from math import comb

import numpy as np
from numpy.typing import NDArray

from recognition.features_footprint import PadGrid, pressed

_LEVELS = (1, 4)
_WIDTHS_MM = (2.0, 3.4, 5.4)
_CRESTS = (1, 2, 3, 4)
_MARGIN_MM = 6.8
"""Centres lie as far beyond the pad: there the rim of a patch answers."""
_MIN_LOAD = 1e-3
_PEAK_FLOOR_PER_MM = 1.3e-3
_ENERGY_FLOOR = 2e-4


def harmonic_features(
    maps: NDArray[np.float64], noise: NDArray[np.float64], grid: PadGrid
) -> NDArray[np.float64]:
    """Return (n, F): logarithms of energy and strongest answer of each harmonic, at two levels.

    Parameters
    ----------
    maps : (n, K, n_taxels)
        Values above rest, as a fraction of full scale.
    noise : (n, K)
        Standard deviation of each value.
    grid
        The pad.
    """
    levels = [k for k in _LEVELS if k < maps.shape[1]]
    patch = pressed(maps[:, levels], noise[:, levels])
    area_mm2 = float(np.prod(grid.pitch_mm))
    load = np.maximum(patch.sum(axis=-1, keepdims=True), _MIN_LOAD)
    root_per_mm = np.sqrt(patch / (load * area_mm2)).reshape(-1, *grid.shape)
    squared = _squared_answers(root_per_mm, grid)
    features = np.stack(
        [
            np.log(squared.sum(axis=-1) * area_mm2 + _ENERGY_FLOOR),
            np.log(np.sqrt(squared.max(axis=-1)) + _PEAK_FLOOR_PER_MM),
        ],
        axis=-1,
    )
    return features.reshape(len(maps), -1)


def _squared_answers(root: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return (n, widths, harmonics, places): squared answers to roots of density (n, *shape)."""
    rows_mm = grid.xy_mm[:, 0].reshape(grid.shape).mean(axis=1)
    columns_mm = grid.xy_mm[:, 1].reshape(grid.shape).mean(axis=0)
    along = _windows(rows_mm, float(grid.pitch_mm[0]))
    across = _windows(columns_mm, float(grid.pitch_mm[1]))
    n_widths, n_powers = along.shape[:2]
    # Powers of x and y under the window first, as both are windows of one axis; then harmonics.
    moments = along.reshape(n_widths, -1, len(rows_mm)) @ (
        root[:, None] @ np.swapaxes(across.reshape(n_widths, -1, len(columns_mm)), 1, 2)
    )
    moments = moments.reshape(len(root), n_widths, n_powers, along.shape[2], n_powers, -1)
    flat = np.swapaxes(moments, 3, 4).reshape(len(root), n_widths, n_powers**2, -1)
    real, imaginary = _harmonics(n_powers)
    squared: NDArray[np.float64] = (real @ flat) ** 2
    squared[:, :, -len(imaginary) :] += (imaginary @ flat) ** 2
    return squared


def _windows(taxels_mm: NDArray[np.float64], pitch_mm: float) -> NDArray[np.float64]:
    """Return (widths, powers, places, taxels): powers of the distance under Gaussian windows."""
    beyond = pitch_mm * np.arange(1, int(np.ceil(_MARGIN_MM / pitch_mm - 1e-6)) + 1)
    places_mm = np.concatenate([taxels_mm[0] - beyond[::-1], taxels_mm, taxels_mm[-1] + beyond])
    widths_mm = np.array(_WIDTHS_MM)[:, None, None]
    distance = (taxels_mm - places_mm[:, None]) / widths_mm
    window = np.exp(-0.5 * distance**2) * (pitch_mm / (widths_mm * np.sqrt(2 * np.pi)))
    return np.stack([window * distance**power for power in range(max(_CRESTS) + 1)], axis=1)


def _harmonics(n_powers: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return real parts (harmonics, powers²) and the imaginary parts of the waves, the last ones.

    Two bumps and the waves (x + i y)^crests, by their weights of x^a y^b at a * powers + b.
    """
    weight = np.zeros((2 + len(_CRESTS), n_powers, n_powers), dtype=np.complex128)
    weight[:2, 0, 0] = 1.0, -2.0
    weight[1, 2, 0] = weight[1, 0, 2] = 1.0
    for row, crests in enumerate(_CRESTS, start=2):
        for b in range(crests + 1):
            weight[row, crests - b, b] = comb(crests, b) * 1j**b
    flat = weight.reshape(len(weight), -1)
    return np.ascontiguousarray(flat.real), np.ascontiguousarray(flat.imag[2:])
