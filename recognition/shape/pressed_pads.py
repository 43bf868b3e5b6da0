"""Pressed pads: a grasp reduced to the data for the fit of shapes, at levels of the load."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.errors import ContactError
from recognition.grasp import Grasp, PadArray
from recognition.ramp.ramp import LOAD_FRACTIONS, Rest, find_ramp, load_levels, own_rest
from recognition.shape.foam import FoamModel, PadBed

LEVELS = (0.3, 0.7, 1.0)
"""Levels of the load that are fitted, of `recognition.ramp.ramp.LOAD_FRACTIONS`."""

SPREAD_STEP = 0.1
"""Logarithm of the factor between neighbouring spreads of `PressedPads`."""

SPREAD_STEPS = 10
"""Number of spreads on each side of the expected one."""

_WINDOW_M = 30e-3
"""Largest half width in m of the computed part of a pad."""
_MARGIN_M = 3.5e-3
"""Width in m of the unloaded rim of that part, beyond two standard deviations of the load."""
_CELL_M = 0.75e-3
"""Longest side in m of a cell of the pressure grid."""
_TOUCHED_SHARE = 0.25
"""Least share of the largest reading of taxels in centre and spread of the load."""
_TOUCHED_SD = 3.0
"""The same in standard deviations."""
_MODEL_SHARE = 0.02
"""Error of the model as a share of the reading."""
_MODEL_FLOOR = 0.0015
"""Error of the model as a share of full scale."""
_TAXEL_SHARE = 0.04
"""Error of a taxel's gain as a share of its reading, equal at all levels."""
_LEVEL_SHARE = 0.015
"""Error of a reading at one level as a share of it."""
_PRESSED_SD = 3.0
"""Least reading of a pressed taxel in standard deviations."""
_SAME_PLACE_M = 1e-4
"""Largest difference in m between positions of facing taxels."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PressedPads:
    """Combined data of both pads of one grasp, at K levels of the load."""

    bed: PadBed
    """The pad, cropped to the area that can be pressed."""
    along: NDArray[np.float32]
    """(S, rows, n_x) float32: `along` of `bed` for S spreads of the pressure, from
    e^(-`SPREAD_STEPS` `SPREAD_STEP`) to e^(`SPREAD_STEPS` `SPREAD_STEP`) times as wide."""
    across: NDArray[np.float32]
    """(S, columns, n_y) float32: `across` of `bed` for the same spreads."""
    share: NDArray[np.float64]
    """(K, n_taxels) float64: mean rise of both pads' taxels as a share of the full scale."""
    pressed: NDArray[np.bool_]
    """(n_taxels,) bool: taxels above the noise at the last level; only these show the fit of a
    shape."""
    whitener: NDArray[np.float64]
    """(n_taxels, K, K) float64: transforms the deviations of one taxel at all levels into
    independent ones of variance 1. Besides noise a taxel has errors that grow with its load: those
    of its gain and of the model."""
    aperture_m: NDArray[np.float64]
    """(K,) float64: opening in m; NaN if unknown."""
    force_n: float
    """Commanded force at the last level in N; NaN if unknown."""
    centre_m: NDArray[np.float64]
    """(2,) float64: centroid of the load in the pads' plane."""
    spread_m2: NDArray[np.float64]
    """(2, 2) float64: second moments of the load about it."""


def reduce_to_pads(grasp: Grasp, foam: FoamModel) -> PressedPads:
    """Return a grasp reduced to pressed pads.

    Raises ContactError if a pad was not touched, the pads do not face each other taxel by taxel, or
    have no regular grid.

    Parameters
    ----------
    grasp
        From the open gripper on.
    foam
        For the spread of the pressure.
    """
    rest = own_rest(grasp)
    pads = grasp.pads
    first = _facing_pads(pads, rest)
    levels = load_levels([grasp], rest)
    if not levels.touched[0]:
        raise ContactError("not both pads were touched; grip harder or tare again")
    chosen = [LOAD_FRACTIONS.index(level) for level in LEVELS]
    maps = np.stack([m[0, chosen] for m in levels.maps])
    ramp = find_ramp(grasp, rest)
    rest_sd = ramp.noise_counts / (pads.adc_max * np.sqrt(ramp.n_quiet))
    noise = np.hypot(levels.noise[0, chosen], rest_sd)
    totals = maps.sum(axis=2)
    # Both pads carry the same force, so a difference is that of their gains.
    gain = totals.sum(axis=1)
    if not np.all(gain > 0.0):
        raise ContactError("a pad carries no load at the end of the ramp")
    maps *= (gain.mean() / gain)[:, None, None]
    # Facing pads have one contact, so the order of columns with the more similar readings is true.
    own, facing = maps.reshape(*maps.shape[:2], *pads.pad_shape[first])
    if float((own[-1] * facing[-1, :, ::-1]).sum()) > float((own[-1] * facing[-1]).sum()):
        maps[1] = facing[:, :, ::-1].reshape(len(facing), -1)
    share = maps.mean(axis=0)
    sd = np.sqrt(
        (noise**2).sum(axis=1)[:, None] / 4.0 + _MODEL_FLOOR**2 + (_MODEL_SHARE * share) ** 2
    )
    xy_m = pads.taxel_xy_m[pads.taxels_of(first)]
    centre_m, spread_m2 = _centre_and_spread(share[-1], sd[-1], xy_m)
    half_m = np.minimum(_MARGIN_M + 2.0 * np.sqrt(np.diag(spread_m2)), _WINDOW_M)
    factors = np.exp(SPREAD_STEP * np.arange(-SPREAD_STEPS, SPREAD_STEPS + 1))
    beds = [
        PadBed(pads, first, foam.spread_m * float(factor), cell_m=_CELL_M).cropped(centre_m, half_m)
        for factor in factors
    ]
    return PressedPads(
        bed=beds[SPREAD_STEPS],
        along=np.stack([bed.along for bed in beds]).astype(np.float32),
        across=np.stack([bed.across for bed in beds]).astype(np.float32),
        share=share,
        pressed=share[-1] > _PRESSED_SD * sd[-1],
        whitener=_whitener(share, noise),
        aperture_m=levels.aperture_mm[0, chosen] * 1e-3,
        force_n=float(levels.force_n[0]),
        centre_m=centre_m,
        spread_m2=spread_m2,
    )


def _facing_pads(pads: PadArray, rest: Rest) -> int:
    """Return the first of the two gripping pads; ContactError if they do not face each other."""
    if len(rest.gripping) != 2:
        raise ContactError(f"{len(rest.gripping)} pads grip; size and shape need two")
    first, second = rest.gripping
    same = np.array_equal(pads.pad_shape[first], pads.pad_shape[second]) and np.allclose(
        pads.taxel_xy_m[pads.taxels_of(first)],
        pads.taxel_xy_m[pads.taxels_of(second)],
        atol=_SAME_PLACE_M,
    )
    if not same:
        raise ContactError(f"pads {first} and {second} do not face each other taxel by taxel")
    return first


def _centre_and_spread(
    top: NDArray[np.float64], sd: NDArray[np.float64], xy_m: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centre (2,) in m and second moments (2, 2) in m² of the load at the last level."""
    least = max(_TOUCHED_SHARE * float(top.max()), _TOUCHED_SD * float(sd.min()))
    load = np.where(top > least, top, 0.0)
    if not load.any():
        load = np.where(top == top.max(), 1.0, 0.0)
    load = load / load.sum()
    centre_m = load @ xy_m
    away_m = xy_m - centre_m
    return centre_m, (load[:, None] * away_m).T @ away_m


def _whitener(share: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverse Cholesky factor of the covariance of the K levels of each taxel.

    It is (n_taxels, K, K), for shares (K, n_taxels) and noise (K, 2).
    """
    alone = (noise**2).sum(axis=1) / 4.0 + _MODEL_FLOOR**2
    by_taxel = share.T
    covariance = (_TAXEL_SHARE**2) * by_taxel[:, :, None] * by_taxel[:, None, :]
    variance = alone + (_LEVEL_SHARE * by_taxel) ** 2
    covariance += variance[:, :, None] * np.eye(len(share))
    return np.linalg.inv(np.linalg.cholesky(covariance))
