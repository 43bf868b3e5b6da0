"""Features of each pad's patch: load profiles, circular harmonics.

Constants without another source were chosen on the teaching grasps of 36 recorded objects
(docs/explanations/recogniser.md).
"""

from collections.abc import Sequence
from math import comb

import numpy as np
from numpy.typing import NDArray

from recognition.features.footprint import Footprint, PadGrid

_LEAST_LOAD = 0.01
"""Least divisor of the shares of a profile, in full scales of a taxel."""

_HARMONIC_LEVELS = (1, 4)
"""Levels of `recognition.ramp.levels.LOAD_FRACTIONS` for the harmonics: 0.5 and 1."""
_WIDTHS_MM = (2.0, 3.4, 5.4)
"""Standard deviations of the Gaussian windows in mm."""
_CRESTS = (1, 2, 3, 4)
"""Numbers of crests of the waves around a centre."""
_MARGIN_MM = 6.8
"""Margin of the centres around the pad in mm, for the responses of the rim of a patch."""
_PATCHES_AT_ONCE = 64
"""Number of patches at a time, so that their responses fit into the processor's cache."""
_MIN_LOAD = 1e-3
"""Least divisor of a density, in full scales of a taxel."""
_PEAK_FLOOR_PER_MM = 1.3e-3
_ENERGY_FLOOR = 2e-4
"""Added to the strongest response in 1/mm and to the energy before their logarithms."""


def profile_features(footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): roots of the shares of load per row and column at full load, of each pad.

    Once in place on the pad, once centred on the patch.
    """
    parts: list[NDArray[np.float64]] = []
    for footprint in footprints:
        patch = footprint.pressed[:, -1].reshape(-1, *footprint.grid.shape)
        load = np.maximum(patch.sum(axis=(1, 2)), _LEAST_LOAD)[:, None]
        for other_axis in (2, 1):
            share = patch.sum(axis=other_axis) / load
            parts += [np.sqrt(share), np.sqrt(_centred(share))]
    return np.concatenate(parts, axis=1)


def _centred(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift each row so that its centre of mass is in the middle; linear between neighbours."""
    n, length = share.shape
    reach = (length + 1) // 3 + 1
    centre = share @ np.arange(length) / np.maximum(share.sum(axis=1), 1e-9)
    position = centre[:, None] + np.arange(-reach, reach + 1)
    left = np.floor(position).astype(np.int64)
    part = position - left
    beyond = reach + 1
    padded = np.pad(share, ((0, 0), (beyond, beyond)))
    rows = np.arange(n)[:, None]
    at_left, at_right = padded[rows, left + beyond], padded[rows, left + beyond + 1]
    moved: NDArray[np.float64] = at_left * (1.0 - part) + at_right * part
    return moved


def harmonic_features(footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): logarithms of energy and strongest response of each circular harmonic.

    A circular harmonic is a bump under a Gaussian window, or a wave with a number of crests around
    its centre (Freeman and Adelson, "The design and use of steerable filters", 1991). Its response
    at a place of the pad is the correlation with the pressure there. With fine taxels, strongest
    response and energy do not change when the patch moves or turns. They do not need the centre of
    the patch, which the rim of the pad may cut off. The filtered quantity is the root of the
    density of load, with unit energy, so that a gain does not change the features.
    """
    return np.concatenate([_harmonics_of(footprint) for footprint in footprints], axis=1)


def _harmonics_of(footprint: Footprint) -> NDArray[np.float64]:
    grid, patch = footprint.grid, footprint.pressed[:, _HARMONIC_LEVELS]
    area_mm2 = float(np.prod(grid.pitch_mm))
    load = np.maximum(patch.sum(axis=-1, keepdims=True), _MIN_LOAD)
    root_per_mm = np.sqrt(patch / (load * area_mm2)).reshape(-1, *grid.shape)
    parts = []
    for start in range(0, len(root_per_mm), _PATCHES_AT_ONCE):
        squared = _squared_answers(root_per_mm[start : start + _PATCHES_AT_ONCE], grid)
        energy = np.log(squared.sum(axis=-1) * area_mm2 + _ENERGY_FLOOR)
        strongest = np.log(np.sqrt(squared.max(axis=-1)) + _PEAK_FLOOR_PER_MM)
        parts.append(np.stack([energy, strongest], axis=-1))
    return np.concatenate(parts).reshape(len(patch), -1)


def _squared_answers(root: NDArray[np.float64], grid: PadGrid) -> NDArray[np.float64]:
    """Return (n, widths, harmonics, places): squared responses to roots of density (n, *shape)."""
    rows_mm = grid.xy_mm[:, 0].reshape(grid.shape).mean(axis=1)
    columns_mm = grid.xy_mm[:, 1].reshape(grid.shape).mean(axis=0)
    along = _windows(rows_mm, float(grid.pitch_mm[0]))
    across = _windows(columns_mm, float(grid.pitch_mm[1]))
    n_widths, n_powers = along.shape[:2]
    # Powers of x and y under the window first, because both are windows of one axis.
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
