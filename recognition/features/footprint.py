"""Footprint of one pad: size, area, elongation, sharpness and moments of the pressed patch."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray

_NOISE_SIGMAS = 3.0
"""Values up to this number of standard deviations of their noise are set to 0."""
_FLOOR = 0.004
"""Values up to this share of full scale are set to 0: one count of 255."""
_PROFILE_LENGTH = 20
"""Number of the largest values of a patch that describe its sharpness."""
LOAD_FLOOR = 1e-2
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
    kept: NDArray[np.float64] = np.where(maps > limit, maps, 0.0)
    return kept


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
        log_load=np.log(total + LOAD_FLOOR),
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
