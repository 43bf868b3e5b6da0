"""Self-zero: what empty fingers that press on each other show of a hand, and what has changed.

Both pads feel one force, foam on foam. Locally the pressure of the column (x, y) is

    max(0, c + g_x x + g_y y)    with    c = K (z - a)

at the opening a: K is the stiffness of both foams in series, z the opening at which the middles of
the pads meet, g / K their tilt. The footprints give g, and c for each frame; its growth over the
opening gives K and z. The encoders count in steps as large as half of the way: what is read is
taken for what it is, the middle of a step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recognition.drift.drift import Drift, shifted_levels
from recognition.drift.grid import DriftPrior
from recognition.grasp import DRAWING_SOURCE, Grasp, PadArray, SelfZero
from recognition.ramp.levels import Levels, stack_levels

_REST_GAP_M = 1e-3
"""Opening in m beyond that of the first load from which on the pads are taken to be untouched."""
_LEAST_FRAMES = 4
"""Fewest frames of rest, and of the ramp."""
_TOP_SHARE = 0.7
"""Share of the largest load from which on frames show which taxels answer."""
_NEWEST = 3
"""Frames whose mean shows early whether a part is there."""
_SURE_SIGMAS = 5.0
"""How far beyond the noise that has to stand out, in standard deviations: some ten looks a ramp."""
_LEAST_FIT = 0.9
"""Least share of the footprint's variance that pads on each other leave explained: a part between
them makes another footprint."""
_DEAD_SHARE, _DEAD_SIGMAS = 0.25, 6.0
"""Share of its neighbours' load below which a taxel counts as dead, where that stands out so far
from the noise."""
_MIDDLES, _STIFFNESSES, _ZEROS = 400, 81, 161
"""Points of the tables and grids of the fit."""
_LATE_MM = 0.03
"""What an opening is off by beside the step of the encoders, in mm: foam that is not linear, frames
that come after their opening."""
_ALIKE = 5.0
"""Frames in a row that repeat one error of the opening."""
_MODEL_SD_M = 5e-5
"""Error of the opening in m by foam that is not linear, and by its edges; simulated pads."""
_MODEL_RATIO_SD, _MODEL_SCALE_SD, _MODEL_STIFFNESS_SD = 0.02, 0.03, 0.05
"""The same of the logarithms: pads that are misaligned, friction that grows with the load."""
_TORQUE_SD = 0.05
"""Standard deviation of the logarithm of the torque of a servo for its current, between days and
copies of one model; assumed."""
_FOAM_SD, _OTHER_FOAM_SD = 0.1, 0.8
"""The same of the stiffness of foam: of one foam between days and temperatures, assumed, and of two
foams. The latter and `_OTHER_FOAM` are tuned on nine simulated cells whose foam has 1.2 to 2.4
times the modulus: 0.5 to 0.8, and 0.5 to 0.95, name as many."""
_OTHER_FOAM = 0.5
"""Probability that the foam is another one than at teaching, before it is measured."""
_FOAM_CAUTION = 0.25
"""By so much of their value the odds of a new object grow on another foam. Tuned on thirty such
cells: 0 to 0.75 name 98 to 95 % right and leave 94 to 97 % of new objects UNKNOWN."""
_SHOWN_SIGMAS = 2.0
"""Standard deviations from which on a change of the foam is reported."""
_DRAWN_SD_M, _DRAWN_RATIO_SD = 5e-5, 0.05
"""The same of the opening in m, and of what the gains of the pads differ by, in virtual grasps of a
drawing: each of them has errors of its own beside."""
_UNKNOWN_SD = 100.0
"""The same of a logarithm of which nothing is known."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ZeroMeasurement:
    """Self-zero, and what the footprint of the pads on each other shows beside it."""

    zero: SelfZero
    """What is kept."""
    tilt_rad: tuple[float, float]
    """How far the gap between the pads closes along the fingers and across, in rad."""
    fit: float
    """Share of the footprint's variance that two plane pads on each other explain, at most 1."""
    dead: tuple[int, ...]
    """Taxels, by their number, that feel nothing where their neighbours do."""

    @property
    def pads_met(self) -> bool:
        """Whether the footprint is that of two pads; otherwise something is between them."""
        return self.fit >= _LEAST_FIT


def measure_zero(
    grasp: Grasp,
    current_a: NDArray[np.float64],
    gripping: tuple[int, int],
    *,
    step_m: float,
) -> ZeroMeasurement:
    """Return what a ramp of the empty fingers on each other shows.

    Parameters
    ----------
    grasp
        From the open fingers to the end of the ramp.
    current_a
        (n_frames,) float64: current of the motors in A at each frame.
    gripping
        Numbers of the two pads in the layout.
    step_m
        Step in which the opening is read, in m: of the encoders of both fingers.

    Raises
    ------
    ValueError
        Frames of rest or ramp are missing, or the pads felt nothing.
    """
    pressing, before, rise = _risen(grasp, gripping)
    taxels = [grasp.pads.taxels_of(pad) for pad in gripping]
    load = np.stack([r.sum(axis=1) for r in rise])
    if np.any(load.mean(axis=1) <= 0.0):
        raise ValueError("a pad has felt nothing while the fingers pressed on each other")
    ratio, ratio_sd = _ratio(load)
    evened = [rise[0] / np.sqrt(ratio), rise[1] * np.sqrt(ratio)]
    footprint = _of_both(evened, alike=_alike(grasp.pads, gripping))
    xy_m = grasp.pads.taxel_xy_m[taxels[0]]
    gradient, middle = _gradient(footprint, xy_m * 1e3)
    met = _meeting(middle, grasp.aperture_m[pressing] * 1e3, step_m * 1e3)
    both = np.stack([e.sum(axis=1) for e in evened]).mean(axis=0)
    log_scale, log_scale_sd = _scale(both, current_a[pressing])
    top = both >= _TOP_SHARE * both.max()
    shown = np.maximum(middle[top].mean() + xy_m @ gradient * 1e3, 0.0)
    spread = footprint[top].mean(axis=0)
    noise = np.concatenate([b.std(axis=0) for b in before]).mean() / np.sqrt(top.sum())
    unexplained = max(float(((spread - shown) ** 2).mean()) - noise**2, 0.0)
    dead = [
        int(taxel)
        for t, felt in zip(taxels, evened, strict=True)
        if len(t) == len(shown)
        for taxel, one, expected in zip(t, felt[top].mean(axis=0), shown, strict=True)
        if one < _DEAD_SHARE * expected and expected > _DEAD_SIGMAS * noise
    ]
    per_mm = np.exp(met.log_counts_mm)
    return ZeroMeasurement(
        zero=SelfZero(
            opening_m=met.zero_mm * 1e-3,
            opening_sd_m=float(np.hypot(met.zero_sd_mm * 1e-3, _MODEL_SD_M)),
            log_gain_ratio=float(np.log(ratio)),
            log_gain_ratio_sd=float(np.hypot(ratio_sd, _MODEL_RATIO_SD)),
            log_scale=log_scale,
            log_scale_sd=float(np.hypot(log_scale_sd, _MODEL_SCALE_SD)),
            log_stiffness=met.log_counts_mm + float(np.log(footprint.shape[1])),
            log_stiffness_sd=float(np.hypot(met.log_counts_mm_sd, _MODEL_STIFFNESS_SD)),
        ),
        tilt_rad=(float(gradient[0] / per_mm), float(gradient[1] / per_mm)),
        fit=float(1.0 - unexplained / (spread**2).mean()),
        dead=tuple(dead),
    )


def drawn_zero(opening_m: float = 0.0, opening_sd_m: float = _DRAWN_SD_M) -> SelfZero:
    """Return the self-zero of a hand as grasps of a drawing have it, both in m.

    The pads feel alike; their counts for current and way, so their common gain, are unknown.
    """
    return SelfZero(
        opening_m=opening_m,
        opening_sd_m=opening_sd_m,
        log_gain_ratio=0.0,
        log_gain_ratio_sd=_DRAWN_RATIO_SD,
        log_scale=0.0,
        log_scale_sd=_UNKNOWN_SD,
        log_stiffness=0.0,
        log_stiffness_sd=_UNKNOWN_SD,
    )


def common_zero(grasps: Sequence[Grasp]) -> SelfZero | None:
    """Return the self-zero that taught grasps are brought to: the newest that was measured.

    None where one of them has none: then the zero that they share is unknown.
    """
    if any(grasp.zero is None for grasp in grasps):
        return None
    return max(grasps, key=lambda grasp: (grasp.source != DRAWING_SOURCE, grasp.start_ms)).zero


def shows_part(grasp: Grasp, gripping: tuple[int, int]) -> bool:
    """Return whether the newest frames of a ramp that still goes on show a part between the pads.

    That is where another footprint than that of two pads stands out from the noise.
    """
    try:
        _, before, rise = _risen(grasp, gripping)
    except ValueError:
        return False
    alike = _alike(grasp.pads, gripping)
    newest = _of_both([one[-_NEWEST:] for one in rise], alike=alike)
    spread = newest.mean(axis=0, keepdims=True)
    if spread.mean() <= 0.0:
        return False
    xy_m = grasp.pads.taxel_xy_m[grasp.pads.taxels_of(gripping[0])]
    gradient, middle = _gradient(spread, xy_m * 1e3)
    shown = np.maximum(middle + xy_m @ gradient * 1e3, 0.0)
    # Noise of the mean, and how far its square over all taxels strays by chance.
    n_pads = 2 if alike else 1
    noise = float(np.concatenate([b.var(axis=0) for b in before]).mean()) / (n_pads * len(newest))
    chance = noise * (1.0 + _SURE_SIGMAS * np.sqrt(2.0 / spread.size))
    unexplained = float(((spread - shown) ** 2).mean() - chance)
    return unexplained > (1.0 - _LEAST_FIT) * float((spread**2).mean())


def since(taught: SelfZero, today: SelfZero, gripping: tuple[int, ...], n_pads: int) -> Drift:
    """Return the drift between two self-zeros that grasps of today are to be freed of.

    That is the zero of the opening, what the gains of the gripping pads differ by, and the
    likeliest gain that they have in common; `prior_since` is what then is left.
    """
    common = _common(taught, today).log_gain
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
    """Return levels of grasps as they would be at the self-zero of teaching.

    Those of grasps without a self-zero stay as they are, and all where none was taught.
    """
    zeros = list(dict.fromkeys(grasp.zero for grasp in grasps))
    if taught is None or not set(zeros) - {None, taught}:
        return levels
    parts, places = [], []
    for zero in zeros:
        rows = np.array([i for i, grasp in enumerate(grasps) if grasp.zero == zero])
        part = levels.take(rows)
        if zero is not None:
            drift = since(taught, zero, gripping, grasps[0].pads.n_pads)
            log_gains = np.log(drift.gains_of(gripping))
            part = shifted_levels(part, log_gains, drift.aperture_offset_m * 1e3)
        parts.append(part)
        places.append(rows)
    return stack_levels(parts).take(np.argsort(np.concatenate(places)))


def prior_since(taught: SelfZero, today: SelfZero) -> DriftPrior:
    """Return what is left unknown of the drift once `since` is undone."""
    offset_sd_m = float(np.hypot(taught.opening_sd_m, today.opening_sd_m))
    return DriftPrior(
        log_gain_sd=_common(taught, today).log_gain_sd, offset_sd_mm=offset_sd_m * 1e3
    )


def foam_caution(taught: SelfZero, today: SelfZero) -> float:
    """Return the factor on the odds of a new object: 1 on the foam of the teaching, else more."""
    return 1.0 + _FOAM_CAUTION * _common(taught, today).other_foam


def foam_change(taught: SelfZero, today: SelfZero) -> float | None:
    """Return how many times as stiff the foam is as at teaching; None where no change is shown."""
    by_current, current_var, by_way, way_var = _shown(taught, today)
    log_ratio = by_way - by_current
    shown = log_ratio**2 > _SHOWN_SIGMAS**2 * (current_var + way_var)
    return float(np.exp(log_ratio)) if shown else None


@dataclass(frozen=True, slots=True, kw_only=True)
class _Common:
    """What grasps of today are freed of on both pads."""

    log_gain: float
    log_gain_sd: float
    """Mean and standard deviation of the logarithm of the counts for each mm over those at
    teaching: gain of the sensors times stiffness of the foam."""
    other_foam: float
    """Probability that the foam is another one."""


def _shown(taught: SelfZero, today: SelfZero) -> tuple[float, float, float, float]:
    """Return the changes of counts for current and of counts for the way since teaching.

    Each is a logarithm with its variance.
    """
    current_var = taught.log_scale_sd**2 + today.log_scale_sd**2 + _TORQUE_SD**2
    way_var = taught.log_stiffness_sd**2 + today.log_stiffness_sd**2
    by_way = today.log_stiffness - taught.log_stiffness
    return today.log_scale - taught.log_scale, current_var, by_way, way_var


def _common(taught: SelfZero, today: SelfZero) -> _Common:
    """Return what grasps are freed of: by the same foam and by another one, weighted.

    A part that is pressed into foam of s times the modulus with s times the force makes the same
    footprint with s times the counts. So counts are compared by the way, not by the force. Counts
    for current show the gain but for the torque, counts for the way its product with the stiffness.
    """
    by_current, current_var, by_way, way_var = _shown(taught, today)
    foam_var = np.array([_FOAM_SD, _OTHER_FOAM_SD]) ** 2
    apart_var = way_var + current_var + foam_var
    other = _OTHER_FOAM if way_var < 1.0 else 1e-9  # without a way nothing is known of the foam
    log_weight = np.log([1.0 - other, other]) - 0.5 * (
        np.log(apart_var) + (by_way - by_current) ** 2 / apart_var
    )
    weight = np.exp(log_weight - np.logaddexp(*log_weight))
    precision = (
        1.0 / (DriftPrior().log_gain_sd ** 2 + np.array([0.0, _OTHER_FOAM_SD**2]))
        + 1.0 / (current_var + foam_var)
        + 1.0 / way_var
    )
    means = (by_current / (current_var + foam_var) + by_way / way_var) / precision
    mean = float(weight @ means)
    variance = float(weight @ (1.0 / precision + (means - mean) ** 2))
    return _Common(log_gain=mean, log_gain_sd=variance**0.5, other_foam=float(weight[1]))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Meeting:
    """Stiffness and opening of pads that meet: means and standard deviations."""

    log_counts_mm: float
    log_counts_mm_sd: float
    zero_mm: float
    zero_sd_mm: float


def _risen(
    grasp: Grasp, gripping: tuple[int, int]
) -> tuple[NDArray[np.int64], list[NDArray[np.float64]], list[NDArray[np.float64]]]:
    """Return the frames of the ramp, and counts of each pad: of open fingers, and above them.

    Raises ValueError where frames of rest or ramp are missing.
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
    """Return whether both pads have as many rows and columns."""
    return np.array_equal(*(pads.pad_shape[pad] for pad in gripping))


def _of_both(rise: Sequence[NDArray[np.float64]], *, alike: bool) -> NDArray[np.float64]:
    """Return the mean footprint of both pads; of pads that differ that of the first."""
    return 0.5 * (rise[0] + rise[1]) if alike else rise[0]


def _gradient(
    footprint: NDArray[np.float64], xy_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return g (2,) in counts/mm and c (n_frames,) in counts of footprints (n_frames, n_taxels)."""
    load = np.maximum(footprint.mean(axis=1), 0.0)
    top = footprint[load >= _TOP_SHARE * load.max()].mean(axis=0)

    def plane(gradient: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return c at which the mean of the plane's pressures is as wanted."""
        lean = xy_mm @ gradient
        middle = np.linspace(-np.abs(lean).max(), np.abs(lean).max() + wanted.max(), _MIDDLES)
        mean = np.maximum(middle[:, None] + lean, 0.0).mean(axis=1)
        found: NDArray[np.float64] = np.interp(wanted, mean, middle)
        return found

    def misfit(gradient: NDArray[np.float64]) -> NDArray[np.float64]:
        middle = plane(gradient, top.mean(keepdims=True))
        off: NDArray[np.float64] = np.maximum(middle + xy_mm @ gradient, 0.0) - top
        return off

    start = np.linalg.lstsq(np.column_stack([xy_mm, np.ones(len(xy_mm))]), top, rcond=None)[0][:2]
    gradient = least_squares(misfit, start).x
    return gradient, plane(gradient, load)


def _meeting(
    middle: NDArray[np.float64], opening_mm: NDArray[np.float64], step_mm: float
) -> _Meeting:
    """Return stiffness and zero by the middle's pressures and the openings read, both (n_frames,).

    What is read lies within a step of the encoders, and frames come late by a little. Stiffness and
    zero are hypotheses on a grid, all stiffnesses as likely by their logarithm.
    """
    least = np.ptp(middle) / (np.ptp(opening_mm) + 2.0 * step_mm)
    log_k = np.log(max(least, 1e-6)) + np.linspace(-0.5, 1.0, _STIFFNESSES)
    # The zero that each frame shows under each stiffness, up to what its step hides.
    shown_mm = opening_mm + middle / np.exp(log_k)[:, None]
    zero_mm = np.linspace(shown_mm.mean(axis=1).min(), shown_mm.mean(axis=1).max(), _ZEROS)
    beyond = np.abs(shown_mm[:, None, :] - zero_mm[:, None]) - 0.5 * step_mm
    misfit = (np.maximum(beyond, 0.0) ** 2).mean(axis=2) / (_LATE_MM**2)
    weight = np.exp(-0.5 * len(middle) / _ALIKE * (misfit - misfit.min()))
    weight /= weight.sum()
    of_k, of_zero = weight.sum(axis=1), weight.sum(axis=0)
    mean_k, mean_zero = float(of_k @ log_k), float(of_zero @ zero_mm)
    return _Meeting(
        log_counts_mm=mean_k,
        log_counts_mm_sd=float(np.sqrt(of_k @ (log_k - mean_k) ** 2)),
        zero_mm=mean_zero,
        zero_sd_mm=float(np.sqrt(of_zero @ (zero_mm - mean_zero) ** 2)),
    )


def _ratio(load: NDArray[np.float64]) -> tuple[float, float]:
    """Return the ratio of two loads (2, n_frames) and the deviation of its logarithm."""
    ratio = float(np.linalg.norm(load[0]) / np.linalg.norm(load[1]))
    off = load[0] / ratio - load[1]
    return ratio, float(off.std() / np.sqrt(load.shape[1]) / load.mean())


def _scale(load: NDArray[np.float64], current_a: NDArray[np.float64]) -> tuple[float, float]:
    """Return the logarithm of counts for each A, and its deviation, by the slope of the ramp.

    Unknown where friction hides what the current grows by, as on a short lever.
    """
    off_load, off_current = load - load.mean(), current_a - current_a.mean()
    a_count = float(off_load @ off_current / (off_load @ off_load))
    if a_count <= 0.0:
        return 0.0, _UNKNOWN_SD
    left = off_current - a_count * off_load
    sd = float(np.sqrt(left @ left / max(len(load) - 2, 1) / (off_load @ off_load)))
    return -float(np.log(a_count)), sd / a_count
