"""Features of a grasp: one table of groups by touch, and the features of the opening.

The footprint of a pad is described by size, form and moments of the pressed patch, and its growth.
Constants without another source were chosen on the teaching grasps of 36 recorded objects
(docs/explanations/recognizer.md). A new group is one function and one entry in `FEATURE_GROUPS`.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import comb
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray
from recognition.ramp.ramp import Levels, Rest

FEATURE_VERSION = 13
"""Version of the features and of their use in a model. Models of another version are refused."""

_NOISE_SIGMAS = 3.0
"""Values up to this number of standard deviations of their noise are set to 0."""
_FLOOR = 0.004
"""Values up to this share of full scale are set to 0: one count of 255."""
_PROFILE_LENGTH = 20
"""Number of the largest values of a patch that describe its sharpness."""
_LOAD_FLOOR = 1e-2
_PEAK_FLOOR = 1e-3
"""Added to loads and peaks before their logarithm, in full scales of a taxel."""
_PEAK_SHARES = (0.1, 0.25, 0.5, 0.75)
"""Shares of the peak above which taxels are counted."""
_PEAK_WIDTH = 0.1
"""Width of the transition from not counted to counted, as a share of the peak."""
_SCALE_SHARES = (0.01, 0.05, 0.15, 0.3)
"""Shares of full scale above which taxels are counted; the width is half of each."""
_COUNT_FLOOR = 0.5
"""Added to numbers of taxels before their logarithm."""
_LEAST_PITCH_MM = 0.1
"""Distance between rows or columns below which they count as one, less than that of any pad."""
_TAIL_FLOOR = 0.1
"""Added to the normalised fourth and sixth moments before their logarithm."""
_TIME_FLOOR_S = 0.05
"""Added to times before their logarithm, in s, so that smaller differences hardly count."""
_LEAST_LOAD = 0.01
"""Least divisor of the shares of a profile, in full scales of a taxel."""
_HARMONIC_LEVELS = (1, 4)
"""Levels of `recognition.ramp.ramp.LOAD_FRACTIONS` for the harmonics: 0.5 and 1."""
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
_YIELD_SCALE_MM = 1 / 3
"""Yield in mm up to which its inverse hyperbolic sine is linear; beyond it grows as a logarithm."""
_SIZE_OFFSET_MM = 3.0
"""Added to a size before its logarithm, in mm, so that small sizes do not dominate."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PadGrid:
    """Positions of the taxels of one pad."""

    xy_mm: NDArray[np.float64]
    """(n_taxels, 2) float64: position in the pad's plane in mm."""
    pitch_mm: NDArray[np.float64]
    """(2,) float64: mean distance between rows, along the finger, and columns, across it, in mm."""
    shape: tuple[int, int]
    """tuple of int: rows and columns."""


def pad_grid(pads: PadArray, pad: int) -> PadGrid:
    """Return the positions of one pad's taxels."""
    xy_mm = pads.taxel_xy_m[pads.taxels_of(pad)] * 1e3
    rows, columns = (int(k) for k in pads.pad_shape[pad])
    grid_mm = xy_mm.reshape(rows, columns, 2)
    along, across = grid_mm[..., 0].mean(axis=1), grid_mm[..., 1].mean(axis=0)
    return PadGrid(
        xy_mm=xy_mm, pitch_mm=np.array([_pitch(along), _pitch(across)]), shape=(rows, columns)
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Footprint:
    """Patches of one pad, n grasps by K levels, described in logarithms and ratios.

    Each array has the shape (n, K) unless noted.
    """

    log_load: NDArray[np.float64]
    log_peak: NDArray[np.float64]
    """Logarithm of the sum and the largest value, in full scales of a taxel."""
    log_extent: NDArray[np.float64]
    """(n, K, 5): logarithm of numbers of taxels: those that carry the load (inverse participation),
    and those above 10, 25, 50 and 75 % of the peak."""
    log_pressed: NDArray[np.float64]
    """(n, K, 4): logarithm of the number of taxels above 1, 5, 15 and 30 % of full scale."""
    log_axes: NDArray[np.float64]
    """(n, K, 3): logarithm of the larger and smaller second moment in mm², and of their ratio."""
    tails: NDArray[np.float64]
    """(n, K, 2): fourth and sixth radial moment against powers of the second, in logarithms."""
    harmonics: NDArray[np.float64]
    """(n, K, 4): magnitudes of third- and fourth-order moments that are invariant under rotation.
    """
    direction: NDArray[np.float64]
    """(n, K, 2): cosine and sine of twice the axis angle, weighted by the elongation."""
    centroid_mm: NDArray[np.float64]
    """(n, K, 2): centre of the load in mm."""
    profile: NDArray[np.float64]
    """(n, 20): root of the largest values at full load, in falling order, over the peak."""
    pressed: NDArray[np.float64]
    """(n, K, n_taxels): the patches themselves, with possible noise set to 0."""
    grid: PadGrid


def pressed(maps: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `maps` (..., n_taxels) with possible noise set to 0; noise has shape (...)."""
    limit = np.maximum(_NOISE_SIGMAS * noise, _FLOOR)[..., None]
    return np.where(maps > limit, maps, 0.0)


def describe_footprint(
    maps: NDArray[np.float64], noise: NDArray[np.float64], grid: PadGrid
) -> Footprint:
    """Return the footprint of the patches of one pad.

    Parameters
    ----------
    maps : (n, K, n_taxels)
        Values above rest, as a fraction of full scale.
    noise : (n, K)
        Standard deviation of each value.
    """
    m = pressed(maps, noise)
    total = m.sum(axis=-1)
    peak = m.max(axis=-1)
    share = m / np.maximum(total, 1e-9)[..., None]
    share = np.where(total[..., None] > 0, share, 1.0 / m.shape[-1])
    relative = m / np.maximum(peak, 1e-9)[..., None]
    carry = total**2 / np.maximum((m * m).sum(axis=-1), 1e-12)
    profile = -np.sort(-relative[:, -1], axis=-1)[:, :_PROFILE_LENGTH]
    profile = np.pad(profile, ((0, 0), (0, _PROFILE_LENGTH - profile.shape[1])))
    centroid = share @ grid.xy_mm
    dx = grid.xy_mm[:, 0] - centroid[..., 0, None]
    dy = grid.xy_mm[:, 1] - centroid[..., 1, None]
    # A patch is never thinner than a taxel, so the taxel's width is added to the moments.
    own_x, own_y = grid.pitch_mm**2 / 4
    xx = (share * dx * dx).sum(axis=-1) + own_x
    yy = (share * dy * dy).sum(axis=-1) + own_y
    xy = (share * dx * dy).sum(axis=-1)
    half, swing = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    large, small = np.log(half + swing), np.log(half - swing)
    r2, second, z = dx * dx + dy * dy, xx + yy, dx + 1j * dy
    weighted = share * z * z
    fourth, sixth = (share * r2**2).sum(-1) / second**2, (share * r2**3).sum(-1) / second**3
    cubic, quartic = np.maximum(second, 1e-9) ** 1.5, np.maximum(second, 1e-9) ** 2
    return Footprint(
        log_load=np.log(total + _LOAD_FLOOR),
        log_peak=np.log(peak + _PEAK_FLOOR),
        log_extent=np.log(
            np.stack(
                [carry] + [_soft_count(relative, q, _PEAK_WIDTH) for q in _PEAK_SHARES], axis=-1
            )
            + _COUNT_FLOOR
        ),
        log_pressed=np.log(
            np.stack([_soft_count(m, q, q / 2) for q in _SCALE_SHARES], axis=-1) + _COUNT_FLOOR
        ),
        log_axes=np.stack([large, small, large - small], axis=-1),
        tails=np.log(np.stack([fourth, sixth], axis=-1) + _TAIL_FLOOR),
        harmonics=np.stack(
            [
                np.abs((weighted * z).sum(-1)) / cubic,
                np.abs((weighted * z.conj()).sum(-1)) / cubic,
                np.abs((weighted * z * z).sum(-1)) / quartic,
                np.abs((weighted * r2).sum(-1)) / quartic,
            ],
            axis=-1,
        ),
        direction=np.stack([(xx - yy) / second, 2 * xy / second], axis=-1),
        centroid_mm=centroid,
        profile=np.sqrt(profile),
        pressed=m,
        grid=grid,
    )


def patch_features(footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): size and form of each pad's patch, unchanged when it moves or turns."""
    return _side_by_side(
        part
        for f in footprints
        for part in (
            f.log_load,
            f.log_peak,
            f.log_extent,
            f.log_pressed,
            f.log_axes,
            f.tails,
            f.harmonics,
            f.profile,
        )
    )


def pose_features(footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): direction of the long axis and centre of the load of each pad's patch."""
    return _side_by_side(part for f in footprints for part in (f.direction, f.centroid_mm))


def pad_difference_features(footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): differences of load, peak, size and centre of the first two pads.

    F is 0 for a single pad.
    """
    if len(footprints) < 2:
        return np.zeros((len(footprints[0].log_load), 0))
    a, b = footprints[:2]
    return _side_by_side(
        (
            a.log_load - b.log_load,
            a.log_peak - b.log_peak,
            a.log_axes[..., 0] - b.log_axes[..., 0],
            a.centroid_mm - b.centroid_mm,
        )
    )


def growth_features(levels: Levels, footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): growth of patch and load over the levels, load over time, times of the levels.

    They show curvature, compliance and creep.
    """
    parts: list[NDArray[np.float64]] = []
    for print_ in footprints:
        extent, axes = print_.log_extent[..., 0], print_.log_axes
        parts.append(extent[:, -1] - extent[:, 0])
        parts.append(axes[:, -1, :2] - axes[:, 0, :2])
        parts.append(print_.log_load[:, -1:] - print_.log_load[:, :-1])
    timed = np.log(np.maximum(levels.timed_load, 0.0) + _LOAD_FLOOR)
    parts.append(timed[..., -1:] - timed[..., :-1])
    parts.append(np.log(np.maximum(levels.level_time_s, 0.0) + _TIME_FLOOR_S))
    parts.append(levels.touch_delay_s)
    return _side_by_side(parts)


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
    return np.asarray(at_left * (1.0 - part) + at_right * part, dtype=np.float64)


def harmonic_features(footprints: Sequence[Footprint]) -> NDArray[np.float64]:
    """Return (n, F): logarithms of energy and strongest response of each circular harmonic.

    A circular harmonic is a bump under a Gaussian window, or a wave with a number of crests around
    its centre. Source: Freeman and Adelson, "The design and use of steerable filters", 1991. Its
    response at a place of the pad is the correlation with the pressure there. With fine taxels,
    strongest response and energy do not change when the patch moves or turns. They do not need the
    centre of the patch, which the rim of the pad may cut off. The filtered quantity is the root of
    the density of load, with unit energy, so that a gain does not change the features.
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


def sizes_mm(levels: Levels) -> NDArray[np.float64]:
    """Return (n, 2): the opening in mm under the full load, and at the first touch of both pads."""
    return np.stack([levels.aperture_mm[:, -1], levels.touch_aperture_mm.min(axis=1)], axis=1)


def aperture_features(levels: Levels) -> NDArray[np.float64]:
    """Return (n, F): sizes in mm and their logarithms, and the closing of the fingers by the load.

    NaN if the opening is unknown.
    """
    sizes = sizes_mm(levels)
    final, both = sizes[:, :1], sizes[:, 1:]
    first = levels.touch_aperture_mm[:, :1] - levels.touch_aperture_mm[:, -1:]
    squeeze = both - final
    return np.concatenate(
        [
            sizes,
            np.log(np.maximum(sizes, 0.0) + _SIZE_OFFSET_MM),
            first,
            squeeze,
            np.arcsinh(squeeze / _YIELD_SCALE_MM),
            np.arcsinh((levels.aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
            np.arcsinh((levels.timed_aperture_mm - final)[:, :-1] / _YIELD_SCALE_MM),
        ],
        axis=1,
    )


FEATURE_GROUPS: Mapping[str, Callable[[Levels, Sequence[Footprint]], NDArray[np.float64]]] = (
    MappingProxyType(
        {
            # Size and form of the pressed patch, unchanged when it moves or turns on the pad.
            "patch": lambda _, pads: patch_features(pads),
            # Position of the patch on the pad, and its rotation.
            "pose": lambda _, pads: pose_features(pads),
            # One pad against the other.
            "pads": lambda _, pads: pad_difference_features(pads),
            # Growth of patch and load along the ramp.
            "growth": growth_features,
            # Load per row and column of taxels.
            "profile": lambda _, pads: profile_features(pads),
            # Details of the patch. With the opening they add nothing.
            "harmonics": lambda _, pads: harmonic_features(pads),
        }
    )
)
"""All features by touch by the name of their group, in their order in a vector. Each returns the
features (n, F) float64 of n grasps, from their levels and the footprint of each gripping pad."""
_TOUCH_ALONE = frozenset({"harmonics"})
"""Groups that vectors with the opening leave out."""


def pad_grids(rest: Rest) -> list[PadGrid]:
    """Return the positions of the taxels of the gripping pads."""
    return [pad_grid(rest.pads, pad) for pad in rest.gripping]


def touch_features(
    levels: Levels, grids: Sequence[PadGrid], *, opening: bool
) -> NDArray[np.float64]:
    """Return the features by touch, (n, F) float64.

    ``opening`` is whether the vector also has features of the opening.
    """
    footprints = [
        describe_footprint(maps, levels.noise[..., pad], grid)
        for pad, (maps, grid) in enumerate(zip(levels.maps, grids, strict=True))
    ]
    groups = [name for name in FEATURE_GROUPS if not (opening and name in _TOUCH_ALONE)]
    return np.concatenate([FEATURE_GROUPS[name](levels, footprints) for name in groups], axis=1)


def features_of(levels: Levels, rest: Rest, *, opening: bool) -> NDArray[np.float64]:
    """Return `touch_features`; with ``opening`` those of the opening follow, NaN if unknown."""
    touch = touch_features(levels, pad_grids(rest), opening=opening)
    return np.concatenate([touch, aperture_features(levels)], axis=1) if opening else touch


def _side_by_side(parts: Iterable[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return parts (n, ...) as one array (n, F)."""
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def _soft_count(values: NDArray[np.float64], level: float, width: float) -> NDArray[np.float64]:
    """Return the number of values above a level; within half a width of it they count in part."""
    counted: NDArray[np.float64] = np.clip((values - level) / width + 0.5, 0.0, 1.0).sum(axis=-1)
    return counted


def _pitch(places_mm: NDArray[np.float64]) -> float:
    """Return the mean distance between neighbouring rows or columns in mm, or 1."""
    pitch_mm = float(np.ptp(places_mm)) / max(1, len(places_mm) - 1)
    return pitch_mm if pitch_mm >= _LEAST_PITCH_MM else 1.0
