"""Self-zero: state of a hand, measured with empty fingers that press on each other.

Both pads carry one force, foam on foam. Locally the pressure of the column (x, y) is

    max(0, c + g_x x + g_y y)    with    c = K (z - a)

at the opening a: K is the stiffness of both foams in series, z the opening at which the middles of
the pads meet, g / K their tilt. The footprints give g, and c for each frame; its growth over the
opening gives K and z. A step of the encoders is as large as half of the travel, so each reading is
taken as the middle of a step. While one finger moves alone, the other one's reading has one
constant error, and the steps of the moving one measure the travel.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import expit, logsumexp

from recognition.drift.drift import Drift, DriftPrior, moments
from recognition.grasp import DRAWING_SOURCE, Grasp, PadArray, SelfZero
from recognition.ramp.ramp import Levels

_REST_GAP_M = 1e-3
"""Opening in m beyond that of the first load from which the pads count as untouched."""
_LEAST_FRAMES = 4
"""Fewest frames of rest, and of the ramp."""
_TOP_SHARE = 0.7
"""Least share of the largest load of the frames that show dead taxels."""
_LEAST_GROWTH = 0.3
"""Least growth of the load in the ramp, as a share of the largest load: without growth the zero of
the opening cannot be told from the stiffness. [chosen]"""
_NEWEST = 3
"""Number of frames whose mean shows early whether a part is present."""
_SURE_SIGMAS = 5.0
"""Standard deviations of the noise that a part must exceed, with about ten checks in a ramp."""
_LEAST_FIT = 0.9
"""Least share of the footprint's variance that two pads on each other explain: a part between them
makes another footprint."""
_DEAD_SHARE, _DEAD_SIGMAS = 0.25, 6.0
"""Largest share of its neighbours' load of a dead taxel, and standard deviations of the noise that
the expected load must exceed."""
_MIDDLES, _STIFFNESSES, _ZEROS, _ERRORS = 400, 81, 161, 7
"""Points of the tables and grids of the fit."""
_LATE_MM = 0.02
"""Error of an opening in addition to the step of the encoders, in mm: non-linear foam, frames later
than their opening."""
_ALIKE = 5.0
"""Number of successive frames with the same error of the opening."""
_MODEL_SD_M = 5e-5
"""Error of the opening in m by non-linear foam, and by its edges; simulated pads."""
_MODEL_RATIO_SD, _MODEL_STIFFNESS_SD = 0.02, 0.05
"""The same of the logarithms, by misaligned pads and by the law of the pads."""
_MOST_STIFFNESS_SD = 1.0
"""Standard deviation beyond which a stiffness counts as unknown."""
_OTHER_FOAM_SD = 0.8
"""Standard deviation of the logarithm of the stiffness of two foams. Half of the hands are expected
to have another foam than that of the teaching. Tuned on nine simulated cells whose foam has 1.2 to
2.4 times the modulus: 0.5 to 0.8 name as many."""
_FOAM_ODDS = 0.4
"""Factor on the odds of a new object on another foam. Tuned on sixteen further cells: 1 to 0.2 name
95 to 97 % of the grasps and leave 100 % of new objects UNKNOWN, and 89 to 80 % of those that differ
from a taught one by 1 or 2 mm."""
_DRAWN_SD_M, _DRAWN_RATIO_SD = 5e-5, 0.05
"""Standard deviations in virtual grasps of a drawing: of the opening in m, and of the ratio of the
pads' gains. Each virtual grasp has further errors of its own."""
_UNKNOWN_SD = 100.0
"""Standard deviation of an unknown logarithm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ZeroMeasurement:
    """Self-zero, and findings from the footprint of the pads on each other."""

    zero: SelfZero
    """The part that is kept."""
    tilt_rad: tuple[float, float]
    """Tilt of one pad relative to the other, along the fingers and across, in rad."""
    fit: float
    """Share of the footprint's variance that two plane pads on each other explain, at most 1."""
    dead: tuple[int, ...]
    """Numbers of the taxels without load among loaded neighbours."""

    @property
    def pads_met(self) -> bool:
        """Whether the footprint is that of two pads; otherwise something is between them."""
        return self.fit >= _LEAST_FIT


def measure_zero(
    grasp: Grasp,
    gripping: tuple[int, int],
    *,
    step_m: float,
    alone: NDArray[np.int64] | None = None,
) -> ZeroMeasurement:
    """Return the self-zero from a ramp of the empty fingers on each other.

    Parameters
    ----------
    grasp
        From the open fingers to the end of the ramp.
    gripping
        Numbers of the two pads in the layout.
    step_m
        Step of the reading of the opening in m, by the encoders of both fingers.
    alone
        (n_frames,) int64: number of the finger that moves alone, -1 while both move; None: both
        move in all frames.

    Raises
    ------
    ValueError
        Frames of rest or ramp are missing, or a pad has no load.
    """
    pressing, before, rise = _risen(grasp, gripping)
    taxels = [grasp.pads.taxels_of(pad) for pad in gripping]
    load = np.stack([r.sum(axis=1) for r in rise])
    if np.any(load.mean(axis=1) <= 0.0):
        raise ValueError("a pad shows no load although the fingers pressed on each other")
    loads = load.sum(axis=0)
    growth = float(1.0 - loads[:_LEAST_FRAMES].mean() / loads.max())
    if growth < _LEAST_GROWTH:
        raise ValueError(
            f"the load of the pads grew by {growth:.0%} of its end, {_LEAST_GROWTH:.0%} are "
            "needed: the fingers met too fast. Lower gripper.approach_speed_mm_s, or raise "
            "gripper.current_max_a"
        )
    ratio, ratio_sd = _ratio(load)
    evened = [rise[0] / np.sqrt(ratio), rise[1] * np.sqrt(ratio)]
    footprint = _of_both(evened, alike=_alike(grasp.pads, gripping))
    xy_m = grasp.pads.taxel_xy_m[taxels[0]]
    gradient, middle = _gradient(footprint, xy_m * 1e3)
    finger = np.full(len(pressing), -1) if alone is None else alone[pressing]
    (log_counts_mm, log_counts_mm_sd), (zero_mm, zero_sd_mm) = _meeting(
        middle, grasp.aperture_m[pressing] * 1e3, step_m * 1e3, finger
    )
    both = np.stack([e.sum(axis=1) for e in evened]).mean(axis=0)
    top = both >= _TOP_SHARE * both.max()
    planes = np.maximum(middle[top].mean() + xy_m @ gradient * 1e3, 0.0)
    spread = footprint[top].mean(axis=0)
    noise = np.concatenate([b.std(axis=0) for b in before]).mean() / np.sqrt(top.sum())
    unexplained = max(float(((spread - planes) ** 2).mean()) - noise**2, 0.0)
    dead = [
        int(taxel)
        for t, evened_pad in zip(taxels, evened, strict=True)
        if len(t) == len(planes)
        for taxel, counts, expected in zip(t, evened_pad[top].mean(axis=0), planes, strict=True)
        if counts < _DEAD_SHARE * expected and expected > _DEAD_SIGMAS * noise
    ]
    per_mm = np.exp(log_counts_mm)
    return ZeroMeasurement(
        zero=SelfZero(
            opening_m=zero_mm * 1e-3,
            opening_sd_m=float(np.hypot(zero_sd_mm * 1e-3, _MODEL_SD_M)),
            log_gain_ratio=float(np.log(ratio)),
            log_gain_ratio_sd=float(np.hypot(ratio_sd, _MODEL_RATIO_SD)),
            log_stiffness=log_counts_mm + float(np.log(footprint.shape[1])),
            log_stiffness_sd=float(np.hypot(log_counts_mm_sd, _MODEL_STIFFNESS_SD)),
        ),
        tilt_rad=(float(gradient[0] / per_mm), float(gradient[1] / per_mm)),
        fit=float(1.0 - unexplained / (spread**2).mean()),
        dead=tuple(dead),
    )


def drawn_zero(opening_m: float = 0.0, opening_sd_m: float = _DRAWN_SD_M) -> SelfZero:
    """Return the self-zero for grasps of a drawing, from an opening and its deviation in m.

    Both pads have the same gain. Counts for travel, and so the gain, are unknown.
    """
    return SelfZero(
        opening_m=opening_m,
        opening_sd_m=opening_sd_m,
        log_gain_ratio=0.0,
        log_gain_ratio_sd=_DRAWN_RATIO_SD,
        log_stiffness=0.0,
        log_stiffness_sd=_UNKNOWN_SD,
    )


def common_zero(grasps: Sequence[Grasp]) -> SelfZero | None:
    """Return the common self-zero of taught grasps: the newest measured one.

    None if one of them has none: then their common zero is unknown.
    """
    if any(grasp.zero is None for grasp in grasps):
        return None
    return max(grasps, key=lambda grasp: (grasp.source != DRAWING_SOURCE, grasp.start_ms)).zero


def shows_part(grasp: Grasp, gripping: tuple[int, int]) -> bool:
    """Return whether the newest frames of a running ramp show a part between the pads.

    A part makes a footprint that differs from that of two pads by more than the noise.
    """
    try:
        _, before, rise = _risen(grasp, gripping)
    except ValueError:
        return False
    alike = _alike(grasp.pads, gripping)
    newest = _of_both([counts[-_NEWEST:] for counts in rise], alike=alike)
    spread = newest.mean(axis=0, keepdims=True)
    if spread.mean() <= 0.0:
        return False
    xy_m = grasp.pads.taxel_xy_m[grasp.pads.taxels_of(gripping[0])]
    gradient, middle = _gradient(spread, xy_m * 1e3)
    plane = np.maximum(middle + xy_m @ gradient * 1e3, 0.0)
    # Noise of the mean, and the random variation of its square over all taxels.
    n_pads = 2 if alike else 1
    noise = float(np.concatenate([b.var(axis=0) for b in before]).mean()) / (n_pads * len(newest))
    chance = noise * (1.0 + _SURE_SIGMAS * np.sqrt(2.0 / spread.size))
    unexplained = float(((spread - plane) ** 2).mean() - chance)
    return unexplained > (1.0 - _LEAST_FIT) * float((spread**2).mean())


def since(taught: SelfZero, today: SelfZero, gripping: tuple[int, ...], n_pads: int) -> Drift:
    """Return the drift between two self-zeros, to correct the grasps of today.

    It has the zero of the opening, the difference between the gains of the gripping pads, and their
    likeliest common gain. `prior_since` is the remaining uncertainty.
    """
    common, _ = _common(taught, today)
    apart = 0.5 * (today.log_gain_ratio - taught.log_gain_ratio)
    gains = np.full(n_pads, np.exp(common))
    if len(gripping) == 2:
        gains[list(gripping)] = np.exp([common + apart, common - apart])
    return Drift(
        gains=tuple(np.clip(gains, 0.2, 5.0).tolist()),
        aperture_offset_m=today.opening_m - taught.opening_m,
    )


def at_zero(
    levels: Levels, grasps: Sequence[Grasp], taught: SelfZero | None, gripping: tuple[int, ...]
) -> Levels:
    """Return levels of grasps, corrected to the self-zero of teaching.

    Levels of grasps without a self-zero are not changed. Without a taught one none are.
    """
    zeros = {grasp.zero for grasp in grasps} - {None}
    if taught is None or not zeros - {taught}:
        return levels
    n_pads = grasps[0].pads.n_pads
    drifts: dict[SelfZero | None, Drift] = {None: Drift(gains=(1.0,))}
    drifts |= {zero: since(taught, zero, gripping, n_pads) for zero in zeros if zero is not None}
    of_each = [drifts[grasp.zero] for grasp in grasps]
    return levels.without_drift(
        np.log([drift.gains_of(gripping) for drift in of_each]),
        1e3 * np.array([[drift.aperture_offset_m] for drift in of_each]),
    )


def prior_since(taught: SelfZero, today: SelfZero) -> DriftPrior:
    """Return the uncertainty of the drift after `since` is corrected."""
    offset_sd_m = float(np.hypot(taught.opening_sd_m, today.opening_sd_m))
    return DriftPrior(log_gain_sd=_common(taught, today)[1], offset_sd_mm=offset_sd_m * 1e3)


def foam_odds(taught: SelfZero, today: SelfZero) -> float:
    """Return the factor on the odds of a new object: 1 on the foam of the teaching, else less.

    On another foam the counts grow differently with the load, so taught objects look a little new.
    A change of the counts that is large beside the gain's from day to day shows another foam.
    """
    change, sd = _common(taught, today)
    variance = DriftPrior().log_gain_sd ** 2 + sd**2 + np.array([0.0, _OTHER_FOAM_SD**2])
    log_weight = -0.5 * (np.log(variance) + change**2 / variance)
    other = float(expit(log_weight[1] - log_weight[0]))
    return 1.0 - (1.0 - _FOAM_ODDS) * other


def _common(taught: SelfZero, today: SelfZero) -> tuple[float, float]:
    """Return mean and standard deviation of the logarithm of the gain of both pads since teaching.

    On foam of s times the modulus, a part with s times the force makes the same footprint with s
    times the counts. So counts are compared by travel, not by force: the gain is that of the
    sensors times the stiffness of the foam. It needs no motor constant.
    """
    sd = float(np.hypot(taught.log_stiffness_sd, today.log_stiffness_sd))
    if sd > _MOST_STIFFNESS_SD:
        return 0.0, DriftPrior().log_gain_sd
    return today.log_stiffness - taught.log_stiffness, sd


def _risen(
    grasp: Grasp, gripping: tuple[int, int]
) -> tuple[NDArray[np.int64], list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Return the frames of the ramp, and counts of each pad: of open fingers, and above them.

    Raises ValueError if frames of rest or ramp are missing.
    """
    pressing = np.flatnonzero(grasp.force_n > 0.0)
    if len(pressing) < _LEAST_FRAMES:
        raise ValueError(f"{len(pressing)} frames of the ramp, {_LEAST_FRAMES} are needed")
    touch_m = float(grasp.aperture_m[pressing[0]])
    open_ = np.flatnonzero(grasp.aperture_m[: pressing[0]] > touch_m + _REST_GAP_M)
    if len(open_) < _LEAST_FRAMES:
        raise ValueError(f"{len(open_)} frames of open fingers, {_LEAST_FRAMES} are needed")
    taxels = [grasp.pads.taxels_of(pad) for pad in gripping]
    before = [grasp.counts[np.ix_(open_, t)].astype(np.float64) for t in taxels]
    rise = [
        grasp.counts[np.ix_(pressing, t)] - rest.mean(axis=0)
        for t, rest in zip(taxels, before, strict=True)
    ]
    return pressing, before, rise


def _alike(pads: PadArray, gripping: tuple[int, int]) -> bool:
    """Return whether both pads have the same rows and columns."""
    return np.array_equal(*(pads.pad_shape[pad] for pad in gripping))


def _of_both(rise: Sequence[NDArray[np.float64]], *, alike: bool) -> NDArray[np.float64]:
    """Return the mean footprint of both pads; if they differ, that of the first pad."""
    return 0.5 * (rise[0] + rise[1]) if alike else rise[0]


def _gradient(
    footprint: NDArray[np.float64], xy_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return g (2,) in counts/mm and c (n_frames,) in counts of footprints (n_frames, n_taxels)."""
    load = np.maximum(footprint.mean(axis=1), 0.0)
    top = footprint[load >= _TOP_SHARE * load.max()].mean(axis=0)

    def plane(gradient: NDArray[np.float64], loads: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return c for the given mean of the plane's pressures."""
        lean = xy_mm @ gradient
        middle = np.linspace(-np.abs(lean).max(), np.abs(lean).max() + loads.max(), _MIDDLES)
        mean = np.maximum(middle[:, None] + lean, 0.0).mean(axis=1)
        return np.interp(loads, mean, middle)

    def misfit(gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        middle = plane(gradient, top.mean(keepdims=True))
        off: NDArray[np.float64] = np.maximum(middle + xy_mm @ gradient, 0.0) - top
        return off

    start = np.linalg.lstsq(np.column_stack([xy_mm, np.ones(len(xy_mm))]), top, rcond=None)[0][:2]
    gradient = least_squares(misfit, start).x
    return gradient, plane(gradient, load)


def _meeting(
    middle: NDArray[np.float64],
    opening_mm: NDArray[np.float64],
    step_mm: float,
    alone: NDArray[np.int64],
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return log counts for each mm and the zero in mm of pads that meet, each with its deviation.

    They follow from the middle's pressures and the openings, both (n_frames,).

    Readings have the error of a step of the encoders, and frames are a little late. Stiffness and
    zero are hypotheses on a grid, with a flat prior of the logarithm of the stiffness. ``alone`` is
    as in `measure_zero`: the error of the finger that stands is a further hypothesis.
    """
    least = np.ptp(middle) / (np.ptp(opening_mm) + 2.0 * step_mm)
    log_k = np.log(max(least, 1e-6)) + np.linspace(-0.5, 1.0, _STIFFNESSES)
    # The zero of each frame for each stiffness, known to one step of the encoders.
    zeros_mm = opening_mm + middle / np.exp(log_k)[:, None]
    zero_mm = np.linspace(zeros_mm.mean(axis=1).min(), zeros_mm.mean(axis=1).max(), _ZEROS)
    log_weight = np.zeros((_STIFFNESSES, _ZEROS))
    for finger in np.unique(alone):
        off_mm = zeros_mm[:, None, alone == finger] - zero_mm[:, None]
        finger_mm = 0.25 * step_mm
        errors_mm = [0.0] if finger < 0 else np.linspace(-finger_mm, finger_mm, _ERRORS)
        box_mm = 0.5 * step_mm if finger < 0 else finger_mm
        beyond = (np.maximum(np.abs(off_mm - error_mm) - box_mm, 0.0) for error_mm in errors_mm)
        misfits = np.stack([(excess**2).sum(axis=2) for excess in beyond]) / _LATE_MM**2
        log_weight += logsumexp(-0.5 / _ALIKE * misfits, axis=0)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    return moments(weight.sum(axis=1), log_k), moments(weight.sum(axis=0), zero_mm)


def _ratio(load: NDArray[np.float64]) -> tuple[float, float]:
    """Return the ratio of two loads (2, n_frames) and the deviation of its logarithm."""
    ratio = float(np.linalg.norm(load[0]) / np.linalg.norm(load[1]))
    off = load[0] / ratio - load[1]
    return ratio, float(off.std() / np.sqrt(load.shape[1]) / load.mean())
