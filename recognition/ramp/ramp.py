"""Ramp of a grasp: load above rest on the gripping pads, the first touch, and the release.

Ramps of any length are reduced to levels: quantities at fixed shares of the load.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.ndimage import uniform_filter1d

from recognition.errors import ContactError
from recognition.grasp import QUIET_FRAMES, Grasp, PadArray
from recognition.records import ArrayRecord

_STARTS_TOUCHED = 0.25
"""Share of a pad's largest load above which its first frames count as loaded."""
_SPIKE_SHARE = 0.2
"""Share of full scale by which a spike exceeds both neighbouring frames; a ramp rises by less."""
_STUCK_SHARE = 0.02
"""Least difference of a stuck taxel from its rest, as a share of full scale."""
_STUCK_SIGMAS = 6.0
"""The same in standard deviations of the noise, more than noise alone reaches."""
# Chosen on recorded grasps, within the part that teaches (docs/explanations/recognizer.md).
_TOUCH_FRACTION = 0.06
"""Least share of its largest load of a touched pad."""
_TOUCH_SIGMAS = 4.0
"""The least load of a touch, in standard deviations of a pad's load at rest."""
_TOUCH_SCALE = 0.005
"""The least load of a touch, as a share of one taxel's full scale."""
_SMOOTHING_FRACTION = 0.06
"""Span of a running mean as a share of the frames of a grasp; more would blur the ramp."""
_MAX_SMOOTHING_FRAMES = 15
"""Longest span of that running mean in frames."""
_GRIPPING_SHARE = 0.1
"""Least rise of a third gripping pad and of further ones, as a share of the largest rise."""
_GRIPPING_SIGMAS = 8.0
"""The same in standard deviations of the pad's load at rest: its noise reaches three at most."""
_HELD_SHARE = 0.95
"""Least share of the highest load at the end of the ramp: less is creep, or the release."""
_HELD_FRAMES = 3
"""Longest running mean of the load in frames for the end of the ramp."""
_OPENED_M = 0.5e-3
"""Least motion in m that counts as an opening after the ramp: creep closes the fingers."""
_QUIET_SHARE = 0.02
"""Largest share of the rise of a pad's total in untouched frames before the touch."""
_NEIGHBOURS = np.array([[[0.0, 1.0, 0.0], [1.0, 0.0, 1.0], [0.0, 1.0, 0.0]]])
"""The four neighbours of a taxel in its row and column."""
_LEAST_FRAMES = 2 * QUIET_FRAMES
"""Fewest frames of a grasp: rest and load, and enough of rest for its noise."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rest(ArrayRecord):
    """Readings of the untouched pads and their noise, from the first frames of taught grasps."""

    pads: PadArray
    """The pads that were taught."""
    gripping: tuple[int, ...]
    """tuple of int: the pads that rise under load, in the order of the layout. They are the one or
    two with the largest rise, and those with at least a tenth of it."""
    counts: NDArray[np.float64]
    """(n_taxels,) float64: reading of each untouched taxel in counts."""
    noise_counts: NDArray[np.float64]
    """(n_gripping,) float64: standard deviation of one sample of an untouched taxel in counts."""

    def __post_init__(self) -> None:
        if not self.gripping or not set(self.gripping) <= set(range(self.pads.n_pads)):
            raise ValueError(f"pads {self.gripping} grip, there are 0 to {self.pads.n_pads - 1}")
        largest = float(np.abs(np.concatenate([self.counts, self.noise_counts])).max())
        if not largest <= self.pads.adc_max:
            raise ValueError(f"untouched pads read {largest:g}, above {self.pads.adc_max}")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Ramp:
    """Rise of one grasp above rest, frame by frame, with the touch of each gripping pad."""

    rise: tuple[NDArray[np.float64], ...]
    """tuple of (n_frames, n_taxels_of_pad) float64: counts above rest of each gripping pad,
    negative noise included."""
    noise_counts: NDArray[np.float64]
    """(n_gripping,) float64: standard deviation of one sample in counts."""
    load: NDArray[np.float64]
    """(n_frames, n_gripping) float64: sum of the rise of each pad in counts."""
    touch: NDArray[np.int64]
    """(n_gripping,) int64: first frame of the lasting touch of each pad; n_frames without a touch.
    """
    n_quiet: int
    """int: frames before any touch and any commanded force; at least those that count as untouched.
    """
    smoothing: int
    """int: number of frames that a running mean may span without blurring the ramp."""

    @property
    def touched(self) -> bool:
        """Whether two gripping pads were touched, or the only one."""
        return self._second_touch < len(self.load)

    @property
    def start(self) -> int:
        """First frame in which two pads are touched; the last frame if this never happens."""
        return min(self._second_touch, len(self.load) - 1)

    @property
    def _second_touch(self) -> int:
        """First frame of the second touch, or of the only pad's; n_frames without one."""
        return int(np.sort(self.touch)[:2][-1])


def learn_rest(grasps: Sequence[Grasp], *, most_pads: int | None = None) -> Rest:
    """Return the rest of the pads, and the gripping pads, from grasps.

    Raises ValueError without grasps, or if they come from different pads or are too short.

    Parameters
    ----------
    grasps
        Of one hand.
    most_pads
        Most gripping pads; None for all that rise under load.
    """
    if not grasps:
        raise ValueError("no grasps to learn from")
    pads = grasps[0].pads
    for grasp in grasps:
        if grasp.pads is not pads and not pads.same_as(grasp.pads):
            raise ValueError("the grasps were taken on different pads: teach pads one by one")
    usual = int(np.median([grasp.n_frames for grasp in grasps]))
    if usual < _LEAST_FRAMES:
        raise ContactError(
            f"the grasps have {usual} frames in the median, at least {_LEAST_FRAMES} are needed: "
            "record whole ramps, from rest to load"
        )
    first = np.stack([g.rest_counts for g in grasps])
    rest = np.median(first, axis=0)
    taxels = [pads.taxels_of(pad) for pad in range(pads.n_pads)]
    noise = np.array([np.median([_spread(g, t) for g in grasps]) for t in taxels])
    rise = np.array(
        [np.median([_highest(g.counts[:, t]) for g in grasps]) - rest[t].sum() for t in taxels]
    )
    least = np.maximum(
        _GRIPPING_SHARE * rise.max(), _GRIPPING_SIGMAS * noise * np.sqrt([len(t) for t in taxels])
    )
    falling = np.argsort(-rise, kind="stable")
    pressed = [*falling[:2], *(pad for pad in falling[2:] if rise[pad] >= least[pad])]
    gripping = sorted(int(pad) for pad in pressed[:most_pads])
    return Rest(pads=pads, gripping=tuple(gripping), counts=rest, noise_counts=noise[gripping])


def own_rest(grasp: Grasp) -> Rest:
    """Return the rest of the two gripping pads by one grasp alone: the mean before the touch.

    Raises ContactError for a grasp that is too short.
    """
    rest = learn_rest([grasp], most_pads=2)
    n_quiet = find_ramp(grasp, rest).n_quiet
    return replace(rest, counts=grasp.counts[:n_quiet].mean(axis=0))


def find_ramp(grasp: Grasp, rest: Rest) -> Ramp:
    """Return the ramp of a grasp: its rise above rest and the lasting touch of each gripping pad.

    The rest is taken from the grasp's own first frames, so it follows a drift. If the pads are
    already loaded there, the taught rest is used. Raises ValueError for other pads.
    """
    rest.pads.check(grasp.pads)
    n = grasp.n_frames
    forced = int(np.argmax(np.append(grasp.force_n > 0.0, True)))
    smoothing = int(np.clip(round(_SMOOTHING_FRACTION * n), 1, _MAX_SMOOTHING_FRAMES))
    rises: list[NDArray[np.float64]] = []
    touch: list[int] = []
    for pad, noise in zip(rest.gripping, rest.noise_counts, strict=True):
        taxels = grasp.pads.taxels_of(pad)
        counts = _without_spikes(grasp.counts[:, taxels].astype(np.float64), rest.pads.adc_max)
        stuck = _stuck_taxels(counts, rest.counts[taxels], float(noise), rest.pads.adc_max)
        own = _rest_now(counts, rest.counts[taxels], float(noise), stuck)
        rise = _with_stuck_replaced(counts - own, stuck, rest.pads.pad_shape[pad])
        smooth = ndimage.uniform_filter1d(rise.sum(axis=1), smoothing, mode="nearest")
        sigma = noise * np.sqrt(len(taxels) / smoothing)
        limit = max(
            _TOUCH_FRACTION * float(smooth.max()),
            _TOUCH_SIGMAS * sigma,
            _TOUCH_SCALE * rest.pads.adc_max,
        )
        free = np.flatnonzero(smooth[: int(np.argmax(smooth)) + 1] < limit)
        begin = int(free[-1]) + 1 if len(free) else 0
        touch.append(begin if float(smooth.max()) >= limit else n)
        rises.append(rise)
    return Ramp(
        rise=tuple(rises),
        noise_counts=rest.noise_counts,
        load=np.stack([rise.sum(axis=1) for rise in rises], axis=1),
        touch=np.array(touch, dtype=np.int64),
        n_quiet=max(QUIET_FRAMES, min(min(touch) - smoothing, forced)),
        smoothing=smoothing,
    )


def held_part(grasp: Grasp, rest: Rest) -> tuple[Grasp, Ramp]:
    """Return a grasp without the frames after its ramp, and its ramp.

    A ramp is the rise of the load, and the time for which the fingers hold the reached load.
    If the commanded force is known, it ends with the last frame of the largest command.
    Otherwise it ends with the last frame near the highest load if the fingers have opened since.
    If the opening is unknown, the load alone decides. The relaxation of a soft object under resting
    fingers is a part of the ramp. Raises ValueError for other pads.
    """
    aperture_m, known = _filled(grasp.aperture_m), np.flatnonzero(np.isfinite(grasp.force_n))
    # A gap at the end, in which the fingers open, is the release.
    gap = 0 < len(known) < grasp.n_frames
    if gap and not aperture_m[-1] - aperture_m[known[-1]] >= _OPENED_M:
        grasp = replace(grasp, force_n=_filled(grasp.force_n))
    ramp, n = find_ramp(grasp, rest), grasp.n_frames
    if not ramp.touched:
        return grasp, ramp
    if grasp.commanded:
        end = int(np.flatnonzero(grasp.force_n >= grasp.force_n.max())[-1]) + 1
    else:
        width = min(_HELD_FRAMES, ramp.smoothing)
        total = ndimage.uniform_filter1d(ramp.load.sum(axis=1), width, mode="nearest")
        highest = float(total.max())
        # If the rest is above all frames, no load shows the end.
        end = int(np.flatnonzero(total >= _HELD_SHARE * highest)[-1]) + 1 if highest > 0.0 else n
        if aperture_m[-1] - aperture_m[end - 1] < _OPENED_M:
            end = n
    end = max(end, int(ramp.start) + 3)
    if end >= n:
        return grasp, ramp
    cut = grasp.first_frames(end)
    return cut, find_ramp(cut, rest)


def _rest_now(
    counts: NDArray[np.float64], taught: NDArray[np.float64], noise: float, stuck: NDArray[np.bool_]
) -> NDArray[np.float64]:
    if _starts_loaded(counts, taught, stuck):
        return taught
    # All frames as low as the first ones are untouched; more frames reduce the noise.
    totals = counts[:, ~stuck].sum(axis=1)
    limit = float(totals[:QUIET_FRAMES].max())
    above = np.flatnonzero(totals > limit + _QUIET_SHARE * (float(totals.max()) - limit))
    end = max(QUIET_FRAMES, int(above[0]) - 1 if len(above) else QUIET_FRAMES)
    change: NDArray[np.float64] = counts[:end].mean(axis=0) - taught
    common = float(change[~stuck].mean())
    # The own change of a taxel counts only beyond the noise.
    own = change - common
    explained = noise**2 / end
    share = max(0.0, 1.0 - explained / max(float((own[~stuck] ** 2).mean()), 1e-12))
    return taught + common + share * own


def _highest(counts: NDArray[np.uint16]) -> float:
    """Return the mean load in counts of a pad over its highest frames."""
    return float(np.sort(counts.sum(axis=1, dtype=np.float64))[-QUIET_FRAMES:].mean())


def _spread(grasp: Grasp, taxels: NDArray[np.int64]) -> float:
    """Return the standard deviation of one sample while nothing is touched, in counts."""
    # In a short grasp the sixth frame may be loaded.
    n = max(QUIET_FRAMES, min(2 * QUIET_FRAMES, grasp.n_frames // 4))
    early = grasp.counts[:n, taxels].astype(np.float64)
    return float(np.sqrt(early.var(axis=0, ddof=min(1, len(early) - 1)).mean()))


def _without_spikes(counts: NDArray[np.float64], adc_max: int) -> NDArray[np.float64]:
    """Replace spikes with the mean of the frames before and after.

    Parameters
    ----------
    counts : (n_frames, n_taxels)
        Readings of one pad.
    """

    def cleaned(frames: NDArray[np.float64]) -> NDArray[np.float64]:
        before, here, after = frames[:-2], frames[1:-1], frames[2:]
        limit = _SPIKE_SHARE * adc_max
        above = here - np.maximum(before, after) > limit
        below = np.minimum(before, after) - here > limit
        return np.where(above | below, 0.5 * (before + after), here)

    if len(counts) < 3:
        return counts
    inner = np.concatenate([counts[:1], cleaned(counts), counts[-1:]])
    # Before the first frame and after the last one the ramp goes on as beside them.
    first, last = 2.0 * inner[1:2] - inner[2:3], 2.0 * inner[-2:-1] - inner[-3:-2]
    return cleaned(np.concatenate([first, inner, last]))


def _stuck_taxels(
    counts: NDArray[np.float64], taught: NDArray[np.float64], noise: float, adc_max: int
) -> NDArray[np.bool_]:
    """Return which taxels change by noise alone, and differ from rest by more than a common drift.

    Parameters
    ----------
    counts : (n_frames, n_taxels)
        Readings of one pad.
    taught : (n_taxels,)
        Untouched reading of each taxel in counts, from teaching.
    noise
        Standard deviation of one sample in counts.
    """
    change = counts[0] - taught
    change = np.abs(change - np.median(change))
    limit = max(_STUCK_SIGMAS * noise, _STUCK_SHARE * adc_max)
    stuck: NDArray[np.bool_] = (np.ptp(counts, axis=0) < limit) & (change > limit)
    if stuck.any():
        # A constant load does not change either. It shows as no load on the other taxels.
        _, largest = _first_and_largest(counts, taught, stuck)
        if largest < limit or _starts_loaded(counts, taught, stuck):
            stuck[:] = False
    return stuck


def _starts_loaded(
    counts: NDArray[np.float64], taught: NDArray[np.float64], stuck: NDArray[np.bool_]
) -> bool:
    """Return whether a pad is loaded in its first frames, or has too few frames."""
    first, largest = _first_and_largest(counts, taught, stuck)
    return len(counts) < 2 * QUIET_FRAMES or first > _STARTS_TOUCHED * largest


def _first_and_largest(
    counts: NDArray[np.float64], taught: NDArray[np.float64], stuck: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the load of the first frames and the largest one, in counts of all taxels."""
    start = counts[:QUIET_FRAMES].mean(axis=0) - taught
    # A drift changes all taxels, an object presses some: a common change is not a load.
    totals = (counts - taught - float(np.median(start)))[:, ~stuck].sum(axis=1)
    return float(totals[:QUIET_FRAMES].mean()), float(totals.max())


def _with_stuck_replaced(
    rise: NDArray[np.float64], stuck: NDArray[np.bool_], shape: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the rise with each stuck taxel replaced by the mean of its sound neighbours.

    Parameters
    ----------
    rise : (n_frames, n_taxels)
        Counts above rest of one pad.
    stuck : (n_taxels,)
        Which taxels are stuck.
    shape : (2,)
        Rows and columns of the pad.
    """
    if not stuck.any():
        return rise
    sound = np.where(stuck, 0.0, rise)
    sums, n = (
        ndimage.convolve(of.reshape(-1, *shape), _NEIGHBOURS, mode="constant").reshape(len(of), -1)
        for of in (sound, (~stuck)[None].astype(np.float64))
    )
    replaced = rise.copy()
    replaced[:, stuck] = (sums / np.maximum(n, 1.0))[:, stuck]
    return replaced


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
        levels = _reduce(*held_part(grasp, rest))
        for rows, values in zip(_arrays(whole), _arrays(levels), strict=True):
            rows[row] = values[0]
    return whole


def stack_levels(parts: Sequence[Levels]) -> Levels:
    """Return one `Levels` from several."""
    return _of_fields(parts, np.concatenate)


def _of_fields(
    parts: Sequence[Levels], join: Callable[[list[NDArray[Any]]], NDArray[Any]]
) -> Levels:
    """Return levels with the joined arrays of the parts."""
    joined = [join(list(arrays)) for arrays in zip(*map(_arrays, parts), strict=True)]
    n_pads = len(parts[0].maps)
    return Levels(maps=tuple(joined[:n_pads]), **dict(zip(_NAMES, joined[n_pads:], strict=True)))


def _arrays(levels: Levels) -> list[NDArray[Any]]:
    return [*levels.maps, *(getattr(levels, name) for name in _NAMES)]


_NAMES = tuple(field.name for field in fields(Levels) if field.name != "maps")


def _reduce(grasp: Grasp, ramp: Ramp) -> Levels:
    n, full = grasp.n_frames, float(grasp.pads.adc_max)
    width = max(ramp.smoothing, _LEAST_WIDTH) if grasp.commanded else ramp.smoothing
    smooth = uniform_filter1d(ramp.load.sum(axis=1), width, mode="nearest")
    last = max(width, int(np.ceil(_FINAL_FRACTION * (n - ramp.start))))
    reference = float(smooth[-last:].mean())
    progress = np.maximum.accumulate(smooth) / reference if reference > 0 else np.ones(n)
    weights = np.stack([_weights(progress, f, width, last) for f in LOAD_FRACTIONS])
    at = weights @ np.arange(n)
    aperture_mm = _filled(grasp.aperture_m) * 1e3
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


def _filled(aperture_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fill unknown openings or forces from their neighbours in time; all NaN stays NaN."""
    good = np.isfinite(aperture_m)
    if good.all() or not good.any():
        return aperture_m
    frames = np.arange(len(aperture_m))
    return np.interp(frames, frames[good], aperture_m[good])
