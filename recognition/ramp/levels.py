"""Levels of load: ramps of any length reduced to quantities at fixed shares of the load."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from recognition.grasp import Grasp
from recognition.ramp.ramp import Ramp, Rest, held_part

LOAD_FRACTIONS = (0.3, 0.5, 0.7, 0.85, 1.0)
"""Levels at which footprints are taken, as fractions of the full load."""

TIME_FRACTIONS = tuple(np.linspace(0.0, 1.0, 9)[1:].tolist())
"""Moments at which the load is taken, as shares of the time from the touch to the end. Under a
commanded force all of them are the end, because the time then depends only on the command."""

_FINAL_FRACTION = 0.125
"""Share of the frames from the touch on, the last ones, whose mean is the full load."""

_LEAST_WIDTH = 5
"""Fewest frames whose mean is a level of a commanded ramp, which may have only a dozen. With two
frames noise costs six of 100 names by touch alone. Chosen on the simulated cell, among 2 to 6."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Levels:
    """Levels of n grasps; n is their number, K the number of levels, P of gripping pads."""

    maps: tuple[NDArray[np.float64], ...]
    """tuple of (n, K, n_taxels_of_pad) float64: mean rise at each level per gripping pad, as a
    fraction of the full scale."""
    noise: NDArray[np.float64]
    """(n, K, P) float64: standard deviation of each value of `maps` by noise."""
    aperture_mm: NDArray[np.float64]
    """(n, K) float64: opening at each level in mm; NaN if unknown."""
    touch_aperture_mm: NDArray[np.float64]
    """(n, P) float64: opening at the first touch of each pad in mm. If a cell stopped at the
    contact, this is the opening of both."""
    timed_load: NDArray[np.float64]
    """(n, P, 8) float64: sum of the rise at `TIME_FRACTIONS`, as a fraction of one taxel's full
    scale."""
    timed_aperture_mm: NDArray[np.float64]
    """(n, 8) float64: opening at `TIME_FRACTIONS` in mm."""
    level_time_s: NDArray[np.float64]
    """(n, K) float64: time from the second touch to each level in s; 0 under a commanded
    force."""
    touch_delay_s: NDArray[np.float64]
    """(n,) float64: time from the touch of the first pad to that of the second in s, negative for
    the reverse; 0 if a cell stopped at the contact."""
    force_n: NDArray[np.float64]
    """(n,) float64: commanded force at the end in N; NaN if unknown."""
    touched: NDArray[np.bool_]
    """(n,) bool: whether two gripping pads were touched, or the only one."""

    def __len__(self) -> int:
        return len(self.force_n)

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Levels":
        """Return some of the grasps, by their indices or by a mask."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        return _of_fields([self], lambda arrays: arrays[0][rows])

    def without_drift(
        self, log_gain: float | NDArray[np.float64], offset_mm: float | NDArray[np.float64]
    ) -> "Levels":
        """Return the levels with a drift undone.

        Parameters
        ----------
        log_gain : (), (P,) or (n, P)
            Logarithm of the gain, common to the gripping pads, of each, or of each in each grasp.
        offset_mm : () or (n, 1)
            Increase of the reading of the opening in mm.
        """
        factors = np.exp(-np.broadcast_to(log_gain, (len(self), len(self.maps))))
        return replace(
            self,
            maps=tuple(m * f[:, None, None] for m, f in zip(self.maps, factors.T, strict=True)),
            noise=self.noise * factors[:, None],
            timed_load=self.timed_load * factors[..., None],
            aperture_mm=self.aperture_mm - offset_mm,
            touch_aperture_mm=self.touch_aperture_mm - offset_mm,
            timed_aperture_mm=self.timed_aperture_mm - offset_mm,
        )


def load_levels(grasps: Sequence[Grasp], rest: Rest) -> Levels:
    """Return grasps reduced to levels. Raises ValueError for pads other than the taught ones."""
    first = _reduce(*held_part(grasps[0], rest))
    # Joining them at the end would need twice the memory.
    whole = _of_fields([first], lambda arrays: np.repeat(arrays[0], len(grasps), axis=0))
    for row, grasp in enumerate(grasps[1:], start=1):
        one = _reduce(*held_part(grasp, rest))
        for rows, of_one in zip(_arrays(whole), _arrays(one), strict=True):
            rows[row] = of_one[0]
    return whole


def stack_levels(parts: Sequence[Levels]) -> Levels:
    """Return one `Levels` from several."""
    return _of_fields(parts, np.concatenate)


def _of_fields(
    parts: Sequence[Levels], join: Callable[[list[NDArray[Any]]], NDArray[Any]]
) -> Levels:
    """Return levels with the joined arrays of the parts."""
    joined = [join(list(one)) for one in zip(*map(_arrays, parts), strict=True)]
    n_pads = len(parts[0].maps)
    return Levels(maps=tuple(joined[:n_pads]), **dict(zip(_NAMES, joined[n_pads:], strict=True)))


def _arrays(levels: Levels) -> list[NDArray[Any]]:
    return [*levels.maps, *(getattr(levels, name) for name in _NAMES)]


_NAMES = tuple(one.name for one in fields(Levels) if one.name != "maps")


def _reduce(grasp: Grasp, ramp: Ramp) -> Levels:
    n, full = grasp.n_frames, float(grasp.pads.adc_max)
    width = max(ramp.smoothing, _LEAST_WIDTH) if grasp.commanded else ramp.smoothing
    smooth = uniform_filter1d(ramp.load.sum(axis=1), width, mode="nearest")
    last = max(width, int(np.ceil(_FINAL_FRACTION * (n - ramp.start))))
    reference = float(smooth[-last:].mean())
    progress = np.maximum.accumulate(smooth) / reference if reference > 0 else np.ones(n)
    weights = np.stack([_weights(progress, f, width, last) for f in LOAD_FRACTIONS])
    at = weights @ np.arange(n)
    aperture_mm = _known(grasp.aperture_m) * 1e3
    frames = np.arange(n, dtype=np.float64)
    t_start, t_end = float(grasp.t_s[ramp.start]), float(grasp.t_s[-1])
    times_s = np.interp(at, frames, grasp.t_s) - t_start
    moments = t_start + (t_end - t_start) * np.array(TIME_FRACTIONS)
    if grasp.commanded:
        times_s, moments = np.zeros_like(times_s), np.full_like(moments, t_end)
    touch = np.minimum(ramp.touch, n - 1)
    if (contact := grasp.contact_frame) is not None:
        touch = np.full_like(touch, contact)
    smooth_pads = uniform_filter1d(ramp.load, width, axis=0, mode="nearest")
    spread = np.sqrt((weights**2).sum(axis=1))[:, None] * ramp.noise_counts
    return Levels(
        maps=tuple((weights @ rise)[None] / full for rise in ramp.rise),
        noise=spread[None] / full,
        aperture_mm=(weights @ aperture_mm)[None],
        touch_aperture_mm=aperture_mm[touch][None],
        timed_load=np.stack([np.interp(moments, grasp.t_s, s) for s in smooth_pads.T])[None] / full,
        timed_aperture_mm=np.interp(moments, grasp.t_s, aperture_mm)[None],
        level_time_s=times_s[None],
        touch_delay_s=np.atleast_1d(grasp.t_s[touch[-1]] - grasp.t_s[touch[0]]),
        force_n=np.atleast_1d(grasp.force_n[-1]),
        touched=np.atleast_1d(ramp.touched),
    )


def _weights(
    progress: NDArray[np.float64], fraction: float, width: int, last: int
) -> NDArray[np.float64]:
    """Return weights of the frames, with sum 1, for the mean state at a load fraction."""
    n = len(progress)
    weights = np.zeros(n)
    if fraction >= 1.0:
        weights[-last:] = 1.0
        return np.asarray(weights / weights.sum(), dtype=np.float64)
    right = int(np.argmax(progress >= fraction))
    left = max(right - 1, 0)
    step = progress[right] - progress[left]
    share = (fraction - progress[left]) / step if step > 0 else 1.0
    for frame, weight in ((left, 1.0 - share), (right, share)):
        begin = frame - (width - 1) // 2
        inside = np.clip(np.arange(begin, begin + width), 0, n - 1)
        np.add.at(weights, inside, weight / width)
    return weights


def _known(aperture_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fill single unknown openings from their neighbours; all NaN stays NaN."""
    good = np.isfinite(aperture_m)
    if good.all() or not good.any():
        return aperture_m
    frames = np.arange(len(aperture_m))
    return np.interp(frames, frames[good], aperture_m[good])
