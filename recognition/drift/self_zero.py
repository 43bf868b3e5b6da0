"""Self-zero: what empty fingers that press on each other show of a hand, and what has changed.

Both pads feel one force, foam on foam. Locally the pressure of column (x, y) at the opening a is

    K * max(0, z + s_x x + s_y y - a)

with the stiffness K of both foams in series, the opening z at which the middles of the pads meet,
and the tilt s of the pads: fitted to all frames of the ramp at once, it gives z whatever the tilt.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from recognition.drift.drift import Drift
from recognition.drift.grid import DriftPrior
from recognition.grasp import Grasp, SelfZero

_REST_GAP_M = 1e-3
"""Opening in m beyond that of the first load from which on the pads are taken to be untouched."""
_LEAST_FRAMES = 4
"""Fewest frames of rest, and of the ramp."""
_TOP_SHARE = 0.7
"""Share of the largest load from which on frames show which taxels answer."""
_LEAST_FIT = 0.6
"""Least share of the footprint's variance that pads on each other leave explained: a part between
them makes another footprint."""
_DEAD_SHARE, _DEAD_SIGMAS = 0.25, 6.0
"""Share of its neighbours' load below which a taxel counts as dead, where that stands out so far
from the noise."""
_MODEL_SD_M = 5e-5
"""Error of the opening in m by foam that is not linear, and by its edges; simulated pads."""
_MODEL_RATIO_SD, _MODEL_SCALE_SD, _MODEL_STIFFNESS_SD = 0.01, 0.03, 0.05
"""The same of the logarithms: pads that are misaligned, friction that grows with the load."""
_TORQUE_SD = 0.05
"""Standard deviation of the logarithm of the torque of a servo for its current, between days and
copies of one model; assumed."""
_FOAM_SD = 0.2
"""The same of the stiffness of foam, between days, copies and temperatures; assumed."""


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
    grasp: Grasp, current_a: NDArray[np.float64], gripping: tuple[int, int]
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

    Raises
    ------
    ValueError
        Frames of rest or ramp are missing, or the pads felt nothing.
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
    load = np.stack([r.sum(axis=1) for r in rise])
    if np.any(load.mean(axis=1) <= 0.0):
        raise ValueError("a pad has felt nothing while the fingers pressed on each other")
    ratio, ratio_sd = _ratio(load)
    evened = [rise[0] / np.sqrt(ratio), rise[1] * np.sqrt(ratio)]
    alike = np.array_equal(*(grasp.pads.pad_shape[pad] for pad in gripping))
    footprint = 0.5 * (evened[0] + evened[1]) if alike else evened[0]
    xy_m = grasp.pads.taxel_xy_m[taxels[0]]
    opening_m = grasp.aperture_m[pressing]
    plane = _fit_plane(footprint, xy_m, opening_m)
    both = np.stack([e.sum(axis=1) for e in evened]).mean(axis=0)
    log_scale, log_scale_sd = _scale(both, current_a[pressing])
    top = both >= _TOP_SHARE * both.max()
    shown = plane.pressure(xy_m, opening_m)[top].mean(axis=0)
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
    return ZeroMeasurement(
        zero=SelfZero(
            opening_m=plane.opening_m,
            opening_sd_m=float(np.hypot(plane.opening_sd_m, _MODEL_SD_M)),
            log_gain_ratio=float(np.log(ratio)),
            log_gain_ratio_sd=float(np.hypot(ratio_sd, _MODEL_RATIO_SD)),
            log_scale=log_scale,
            log_scale_sd=float(np.hypot(log_scale_sd, _MODEL_SCALE_SD)),
            log_stiffness=float(np.log(plane.counts_mm * footprint.shape[1])),
            log_stiffness_sd=float(np.hypot(plane.log_counts_mm_sd, _MODEL_STIFFNESS_SD)),
        ),
        tilt_rad=plane.tilt_rad,
        fit=1.0 - unexplained / float((spread**2).mean()),
        dead=tuple(dead),
    )


def since(taught: SelfZero, today: SelfZero, gripping: tuple[int, int], n_pads: int) -> Drift:
    """Return the drift between two self-zeros that grasps of today are to be freed of.

    That is the zero of the opening, and what the gains of both pads differ by; the gain that they
    have in common is undone as far as `prior_since` expects it.
    """
    common = _common(taught, today)[0]
    apart = 0.5 * (today.log_gain_ratio - taught.log_gain_ratio)
    gains = np.full(n_pads, np.exp(common))
    gains[list(gripping)] = np.exp([common + apart, common - apart])
    return Drift(
        gains=tuple(np.clip(gains, 0.2, 5.0).tolist()),
        aperture_offset_m=today.opening_m - taught.opening_m,
    )


def prior_since(taught: SelfZero, today: SelfZero) -> DriftPrior:
    """Return what is left unknown of the drift once `since` is undone."""
    offset_sd_m = float(np.hypot(taught.opening_sd_m, today.opening_sd_m))
    return DriftPrior(
        log_gain_sd=_common(taught, today)[1], offset_sd_mm=offset_sd_m * 1e3, unchanged=0.0
    )


def _common(taught: SelfZero, today: SelfZero) -> tuple[float, float]:
    """Return mean and standard deviation of the logarithm of the gain that both pads share.

    Counts for current show it but for the torque, counts for the way but for the foam.
    """
    by_current = today.log_scale - taught.log_scale
    by_way = today.log_stiffness - taught.log_stiffness
    current_var = taught.log_scale_sd**2 + today.log_scale_sd**2 + _TORQUE_SD**2
    way_var = taught.log_stiffness_sd**2 + today.log_stiffness_sd**2 + _FOAM_SD**2
    precision = 1.0 / DriftPrior().log_gain_sd ** 2 + 1.0 / current_var + 1.0 / way_var
    mean = (by_current / current_var + by_way / way_var) / precision
    return float(mean), float(precision**-0.5)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plane:
    """Two plane pads on each other."""

    counts_mm: float
    log_counts_mm_sd: float
    opening_m: float
    opening_sd_m: float
    tilt_rad: tuple[float, float]

    def pressure(
        self, xy_m: NDArray[np.float64], opening_m: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return counts (n_frames, n_taxels)."""
        values = np.array([self.counts_mm, self.opening_m * 1e3, *self.tilt_rad])
        return _pressure(values, xy_m * 1e3, opening_m * 1e3)


def _pressure(
    values: NDArray[np.float64], xy_mm: NDArray[np.float64], opening_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    counts_mm, zero_mm, tilt_x, tilt_y = values
    reach_mm = zero_mm + xy_mm @ np.array([tilt_x, tilt_y])
    pressure: NDArray[np.float64] = counts_mm * np.maximum(reach_mm - opening_mm[:, None], 0.0)
    return pressure


def _fit_plane(
    footprint: NDArray[np.float64], xy_m: NDArray[np.float64], opening_m: NDArray[np.float64]
) -> _Plane:
    """Fit the pressure of two plane pads to the footprints (n_frames, n_taxels) of a ramp."""
    xy_mm, opening_mm = xy_m * 1e3, opening_m * 1e3
    mean = footprint.mean(axis=1)
    closing_mm = max(float(np.ptp(opening_mm)), 1e-2)
    start = np.array([float(np.ptp(mean)) / closing_mm, float(opening_mm.max()), 0.0, 0.0])
    # The side that carries more shows the way of the tilt.
    moment = footprint.mean(axis=0) @ xy_mm / max(float(footprint.mean(axis=0).sum()), 1e-9)
    start[2:] = moment / np.maximum(xy_mm.var(axis=0), 1e-9) * closing_mm
    found = least_squares(
        lambda values: (_pressure(values, xy_mm, opening_mm) - footprint).ravel(),
        start,
        x_scale=[max(start[0], 1e-3), 0.1, 0.01, 0.01],
    )
    residual = float((found.fun**2).sum()) / max(len(found.fun) - 4, 1)
    covariance = residual * np.linalg.pinv(found.jac.T @ found.jac)
    sds = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    counts_mm = max(float(found.x[0]), 1e-6)
    return _Plane(
        counts_mm=counts_mm,
        log_counts_mm_sd=float(sds[0]) / counts_mm,
        opening_m=float(found.x[1]) * 1e-3,
        opening_sd_m=float(sds[1]) * 1e-3,
        tilt_rad=(float(found.x[2]), float(found.x[3])),
    )


def _ratio(load: NDArray[np.float64]) -> tuple[float, float]:
    """Return the ratio of two loads (2, n_frames) and the deviation of its logarithm."""
    ratio = float(load[0] @ load[0] / (load[0] @ load[1])) ** 0.5 * float(
        load[0] @ load[1] / (load[1] @ load[1])
    ) ** 0.5
    off = load[0] / ratio - load[1]
    return ratio, float(off.std() / np.sqrt(load.shape[1]) / load.mean())


def _scale(load: NDArray[np.float64], current_a: NDArray[np.float64]) -> tuple[float, float]:
    """Return the logarithm of counts for each A, and its deviation, by the slope of the ramp."""
    off_load, off_current = load - load.mean(), current_a - current_a.mean()
    a_count = float(off_load @ off_current / (off_load @ off_load))
    if a_count <= 0.0:
        raise ValueError("the motors' current has not grown while the fingers pressed")
    left = off_current - a_count * off_load
    sd = float(np.sqrt(left @ left / max(len(load) - 2, 1) / (off_load @ off_load)))
    return -float(np.log(a_count)), sd / a_count
