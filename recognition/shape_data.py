"""From a grasp to what a shape is fitted to: pressed pads at a few levels of the ramp."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recognition.errors import ContactError
from recognition.foam_model import FoamModel, PadBed
from recognition.grasp import Grasp
from recognition.ramp import Ramp, Rest, find_ramp, learn_rest
from recognition.ramp_levels import LOAD_FRACTIONS, load_levels

LEVELS = (0.3, 0.7, 1.0)
"""Levels of the load that are fitted, of `recognition.ramp_levels.LOAD_FRACTIONS`."""

SPREAD_STEP = 0.1
"""Logarithm of the factor between neighbouring spreads of `PressedPads`."""

SPREAD_STEPS = 10
"""Spreads on either side of the one that is thought of."""

_WINDOW_M = 13e-3
_BESIDE_M = 3.5e-3
_CELL_M = 0.75e-3
_TOUCHED_SHARE = 0.25
_MODEL_SHARE = 0.02
_MODEL_FLOOR = 0.0015
_TAXEL_SHARE = 0.04
_LEVEL_SHARE = 0.015
_PRESSED_SD = 3.0
_MIN_QUIET = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PressedPads:
    """Both pads of one grasp, laid on each other, at some levels of the load; K levels.

    Attributes
    ----------
    bed
        The pad, cropped to what can be pressed.
    along : (S, rows, n_x) float32
    across : (S, columns, n_y) float32
        Those of `bed` for spreads of the pressure from e^(-`SPREAD_STEPS` `SPREAD_STEP`) to
        e^(`SPREAD_STEPS` `SPREAD_STEP`) times as wide.
    share : (K, n_taxels) float64
        Mean rise of both pads' taxels as a share of the full scale.
    sd : (K, n_taxels) float64
        Standard deviation of each: noise, and what the model is not better than.
    pressed : (n_taxels,) bool
        Taxels that stand out of the noise at the last level: only these tell of a shape's fit.
    whitener : (n_taxels, K, K) float64
        Turns the deviations of one taxel at all levels into independent ones of variance 1: beside
        noise a taxel has errors that grow with its load, its gain and what no model tells.
    aperture_m : (K,) float64
        Opening in m; NaN where unknown.
    force_n
        Commanded force at the last level in N; NaN where unknown.
    centre_m : (2,) float64
        Centroid of the load in the pads' plane.
    spread_m2 : (2, 2) float64
        Second moments of the load about it.
    """

    bed: PadBed
    along: NDArray[np.float32]
    across: NDArray[np.float32]
    share: NDArray[np.float64]
    sd: NDArray[np.float64]
    pressed: NDArray[np.bool_]
    whitener: NDArray[np.float64]
    aperture_m: NDArray[np.float64]
    force_n: float
    centre_m: NDArray[np.float64]
    spread_m2: NDArray[np.float64]

    def tells(self, n_data: int) -> NDArray[np.bool_]:
        """Return which of ``n_data`` residuals tell of a shape: all but those of untouched taxels.

        Residuals are ordered taxel by taxel, in each by level; others follow.
        """
        telling = np.ones(n_data, dtype=bool)
        levels = np.repeat(self.pressed, len(self.share))
        telling[: len(levels)] = levels
        return telling


def press_data(grasp: Grasp, foam: FoamModel, rest: Rest | None = None) -> PressedPads:
    """Reduce a grasp to pressed pads.

    Parameters
    ----------
    grasp
        From the open gripper on.
    foam
        For the spread of the pressure and the offset of the opening.
    rest
        What the pads read untouched; learnt from the grasp's own first frames by default.

    Raises
    ------
    ContactError
        A pad was not touched, or the pads do not face each other taxel by taxel.
    ValueError
        The grasp does not come from the pads of ``rest``.
    """
    rest = rest or learn_rest([grasp])
    pads = grasp.pads
    if len(rest.gripping) != 2:
        raise ContactError(f"{len(rest.gripping)} pads grip; size and shape need two")
    first, second = rest.gripping
    same = np.array_equal(pads.pad_shape[first], pads.pad_shape[second]) and np.allclose(
        pads.taxel_xy_m[pads.taxels_of(first)], pads.taxel_xy_m[pads.taxels_of(second)], atol=1e-4
    )
    if not same:
        raise ContactError(f"pads {first} and {second} do not face each other taxel by taxel")
    levels = load_levels([grasp], rest)
    if not levels.touched[0]:
        raise ContactError("not both pads were touched; grip harder or tare again")
    chosen = [LOAD_FRACTIONS.index(level) for level in LEVELS]
    maps = np.stack([m[0, chosen] for m in levels.maps])
    rest_share, rest_sd = _remaining_rest(find_ramp(grasp, rest), pads.adc_max)
    maps -= rest_share[:, None]
    noise = np.hypot(levels.noise[0, chosen], rest_sd)
    totals = maps.sum(axis=2)
    # Both pads carry the same force: what differs is their gain.
    gain = totals.sum(axis=1)
    if not np.all(gain > 0.0):
        raise ContactError("a pad carries no load at the end of the ramp")
    maps *= (gain.mean() / gain)[:, None, None]
    if _mirrored(maps[:, -1], pads.pad_shape[first]):
        rows, columns = pads.pad_shape[first]
        turned = maps[1].reshape(-1, rows, columns)[:, :, ::-1]
        maps[1] = turned.reshape(len(turned), -1)
    share = maps.mean(axis=0)
    sd = np.sqrt(
        (noise**2).sum(axis=1)[:, None] / 4.0 + _MODEL_FLOOR**2 + (_MODEL_SHARE * share) ** 2
    )
    xy_m = pads.taxel_xy_m[pads.taxels_of(first)]
    top = share[-1]
    load = np.where(
        top > max(_TOUCHED_SHARE * float(top.max()), 3.0 * float(sd[-1].min())), top, 0.0
    )
    if not load.any():
        load = np.where(top == top.max(), 1.0, 0.0)
    load = load / load.sum()
    centre_m = load @ xy_m
    away_m = xy_m - centre_m
    spread_m2 = (load[:, None] * away_m).T @ away_m
    half_m = np.minimum(_BESIDE_M + 2.0 * np.sqrt(np.diag(spread_m2)), _WINDOW_M)
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
        sd=sd,
        pressed=share[-1] > _PRESSED_SD * sd[-1],
        whitener=_whitener(share, noise),
        aperture_m=levels.aperture_mm[0, chosen] * 1e-3 - foam.aperture_offset_m,
        force_n=float(levels.force_n[0]),
        centre_m=centre_m,
        spread_m2=spread_m2,
    )


def _whitener(share: NDArray[np.float64], noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the whitening matrices (n_taxels, K, K) of shares (K, n_taxels) under noise (K, 2)."""
    alone = (noise**2).sum(axis=1) / 4.0 + _MODEL_FLOOR**2
    by_taxel = share.T
    covariance = (_TAXEL_SHARE**2) * by_taxel[:, :, None] * by_taxel[:, None, :]
    variance = alone + (_LEVEL_SHARE * by_taxel) ** 2
    covariance += variance[:, :, None] * np.eye(len(share))
    whitener: NDArray[np.float64] = np.linalg.inv(np.linalg.cholesky(covariance))
    return whitener


def _remaining_rest(ramp: Ramp, adc_max: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what all frames before the touch say is left of the rest, and its noise (2,).

    Both are shares of the full scale; the first has the shape (2, n_taxels).
    """
    end = int(ramp.touch.min()) - ramp.smoothing
    if end < _MIN_QUIET:
        return np.zeros((2, ramp.rise[0].shape[1])), ramp.noise_counts / adc_max
    left = np.stack([rise[:end].mean(axis=0) for rise in ramp.rise])
    return left / adc_max, ramp.noise_counts / (adc_max * np.sqrt(end))


def _mirrored(maps: NDArray[np.float64], shape: NDArray[np.int64]) -> bool:
    """Say whether the second pad counts its columns from the other side.

    Facing pads see one contact: whichever order makes their readings (2, n_taxels) more alike.
    """
    one, two = (m.reshape(shape) for m in maps)
    return float((one * two[:, ::-1]).sum()) > float((one * two).sum())
