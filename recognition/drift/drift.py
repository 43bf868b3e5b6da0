"""Drift of the sensors since teaching: gain of each pad, zero of the opening.

Between days the gain of a pad moves by tens of per cent and the zero of the opening by millimetres.

A grid has hypotheses of both, each with its weight. A self-zero gives the prior. A gauge multiplies
the weights by the likelihood of its known object, likelihood by the placing of objects. A grasp of
an unnamed object multiplies them by its likelihood under any taught object or a new one. This
likelihood has a power, because grasps share errors. An answer is the sum over the grid.

How far days and cells lie apart is learnt from grasps of the same objects. A day effect is what all
values of a day have in common, beside what belongs to the objects.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import logsumexp

from recognition.features import sizes_mm
from recognition.grasp import Grasp, SelfZero
from recognition.ramp.ramp import learn_rest, load_levels
from recognition.recognizer import Recognizer
from recognition.records import ArrayRecord, Numbers

_GAIN_RANGE = (0.2, 5.0)
"""Gains that are accepted: beyond them pads are to be replaced, not corrected."""
_MAX_OFFSET_M = 0.1
"""Largest offset of the opening that is accepted, in m: the stroke of a gripper."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Drift:
    """Drift of the sensors since teaching.

    Raises ValueError where a value is outside of its range.
    """

    gains: tuple[float, ...] = (1.0,)
    """Counts above rest over those of the taught sensor, 0.2 to 5. One value for each pad in the
    order of the layout, or a single one for all pads."""
    aperture_offset_m: float = 0.0
    """Increase of the reading of the opening in m, at most 0.1 in both directions."""

    def __post_init__(self) -> None:
        low, high = _GAIN_RANGE
        if not self.gains or not all(low <= gain <= high for gain in self.gains):
            raise ValueError(f"gain is {self.gains}, must be from {low} to {high}")
        if not abs(self.aperture_offset_m) <= _MAX_OFFSET_M:
            raise ValueError(
                f"the offset of the opening is {self.aperture_offset_m * 1e3:.1f} mm, "
                f"must be within {_MAX_OFFSET_M * 1e3:.0f} mm of 0"
            )

    @property
    def gain(self) -> float:
        """Geometric mean of the gains."""
        return float(np.exp(np.mean(np.log(self.gains))))

    def gains_of(self, pads: tuple[int, ...]) -> NDArray[np.float64]:
        """Return the gain of each of some pads, by their numbers in the layout."""
        return np.array([self.gains[pad if len(self.gains) > 1 else 0] for pad in pads])

    def apply(self, grasp: Grasp) -> Grasp:
        """Return the grasp as a sensor with this drift would have recorded it.

        Counts are scaled, rounded and clipped to full scale, and the opening is shifted. The copy
        has no self-zero, because that was measured before the drift. Raises ValueError if the
        numbers of pads and gains differ.
        """
        return replace(self._moved(grasp, 1), zero=None)

    def undo(self, grasp: Grasp) -> Grasp:
        """Return a grasp recorded under this drift as the taught sensor would have recorded it.

        Counts that were clipped at full scale stay clipped. Raises as `apply`.
        """
        return self._moved(grasp, -1)

    def _moved(self, grasp: Grasp, sign: Literal[1, -1]) -> Grasp:
        n_pads = len(grasp.pads.pad_shape)
        if len(self.gains) not in (1, n_pads):
            raise ValueError(f"{len(self.gains)} gains do not fit the {n_pads} pads of the grasp")
        gains = self.gains_of(tuple(grasp.pads.taxel_pad.tolist()))
        counts = np.clip(np.rint(grasp.counts * gains**sign), 0, grasp.pads.adc_max)
        aperture_m = grasp.aperture_m + sign * self.aperture_offset_m
        return replace(grasp, counts=counts.astype(np.uint16), aperture_m=aperture_m)


def drift_text(drift: Drift) -> str:
    """Return a drift as text for people: ``gain 0.70, opening -4.0 mm``.

    Where the gains of the pads differ, the smallest and the largest are named.
    """
    low, high = (f"{gain:.2f}" for gain in (min(drift.gains), max(drift.gains)))
    gain = low if low == high else f"{low} to {high}"
    return f"gain {gain}, opening {drift.aperture_offset_m * 1e3:+.1f} mm"


_LOG_GAIN_STEP = 1 / 6
"""Largest step between two hypotheses of the logarithm of the gain."""
_OFFSET_STEP_MM = 0.5
"""Largest step between two hypotheses of the opening's zero in mm."""
_REACH = (8 / 3, 3.0)
"""Range of the hypotheses on each side in standard deviations: of gain, of opening."""
_POWER = 0.2
"""Power of the likelihood of an unnamed grasp."""
_MEMORY = 0.95
"""Share of the evidence of unnamed grasps kept after a further one, because drifts change, and
because grasps of the same object in the same pose repeat the same error: all count like four."""
_LASTS_MS = 12 * 3_600_000
"""Time in ms after the newest grasp for which gauges count without a new self-zero: a shift."""
_PLACING_LOG_GAIN = 0.1
"""Standard deviation of the logarithm of the load of one object between placings."""
_LIKELY = 0.9
"""Least probability of a drift that is reported."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftPrior(Numbers):
    """Prior of the drift since teaching, before any object is grasped.

    The default is for another day. Two self-zeros, at teaching and today, narrow it.
    """

    log_gain: float = 0.0
    log_gain_sd: float = 0.25
    """Mean and standard deviation of the logarithm of the gain that all pads have in common."""
    offset_mm: float = 0.0
    offset_sd_mm: float = 3.0
    """Mean and standard deviation of the offset of the opening since teaching, in mm."""
    unchanged: float = 0.5
    """Probability from 0 to 1 that gain and opening are exactly those of teaching."""


@dataclass(frozen=True, kw_only=True, eq=False)
class DriftGrid(ArrayRecord):
    """Weighted hypotheses of the drift since teaching: G gains, O offsets of the opening."""

    prior: DriftPrior = field(default_factory=DriftPrior)
    """Before any grasp; it defines the hypotheses."""
    zero: SelfZero | None = None
    """Self-zero of the day that gives the prior; None without one."""
    gauged: NDArray[np.float64] = field(default_factory=lambda: np.zeros(()))
    """(G, O) float64: log likelihood of the hypotheses by gauges."""
    followed: NDArray[np.float64] = field(default_factory=lambda: np.zeros(()))
    """(G, O) float64: the same by unnamed grasps."""
    n_gauged: int = 0
    n_followed: int = 0
    """Number of gauges and of unnamed grasps."""
    newest_ms: int | None = None
    """Time of the newest grasp of them; None without one."""

    def __post_init__(self) -> None:
        shape = len(self.log_gains), len(self.offsets_mm)
        np.broadcast_shapes(shape, self.gauged.shape, self.followed.shape)

    @cached_property
    def log_gains(self) -> NDArray[np.float64]:
        """(G,) float64: hypotheses of the logarithm of the common gain of all pads."""
        prior = self.prior
        return _axis(prior.log_gain, prior.log_gain_sd * _REACH[0], _LOG_GAIN_STEP)

    @cached_property
    def offsets_mm(self) -> NDArray[np.float64]:
        """(O,) float64: hypotheses of the offset of the opening since teaching, in mm."""
        return _axis(self.prior.offset_mm, self.prior.offset_sd_mm * _REACH[1], _OFFSET_STEP_MM)

    def log_weight(self, unchanged: ArrayLike | None = None) -> NDArray[np.float64]:
        """Return the logarithms of the weights of the hypotheses (..., G, O), which sum to 1.

        ``unchanged`` (...) replaces that of the prior, for example for each object.
        """
        prior = self.prior
        share = np.asarray(prior.unchanged if unchanged is None else unchanged)[..., None, None]
        gain = -0.5 * ((self.log_gains - prior.log_gain) / prior.log_gain_sd) ** 2
        offset = -0.5 * ((self.offsets_mm - prior.offset_mm) / prior.offset_sd_mm) ** 2
        density = gain[:, None] + offset
        weight = (1.0 - share) * np.exp(density - logsumexp(density))
        weight[..., *self._none] += share[..., 0, 0]
        log_weight = np.log(np.maximum(weight, 1e-300)) + self.gauged + self.followed
        return np.asarray(log_weight - logsumexp(log_weight, axis=(-2, -1), keepdims=True))

    def with_gauge(
        self, log_likelihood: NDArray[np.float64], placing_mm: float, at_ms: int
    ) -> Self:
        """Return the grid after grasps of one known object.

        Parameters
        ----------
        log_likelihood : (G, O) or (G, 1)
            Of the grasps under each hypothesis.
        placing_mm
            Standard deviation of the opening on one object between placings in mm.
        at_ms
            Time of the newest grasp.
        """
        shape = (len(self.log_gains), len(self.offsets_mm))
        total = np.broadcast_to(log_likelihood, shape)
        for axis, values, sd in (
            (0, self.log_gains, _PLACING_LOG_GAIN),
            (1, self.offsets_mm, max(placing_mm, 0.5 * _OFFSET_STEP_MM)),
        ):
            blur = -0.5 * ((values[:, None] - values) / sd) ** 2
            blur = blur - logsumexp(blur, axis=1, keepdims=True)
            total = logsumexp(np.expand_dims(np.moveaxis(total, axis, -1), -2) + blur, axis=-1)
            total = np.moveaxis(total, -1, axis)
        gauged = self.gauged + total - total.max()
        return replace(self, gauged=gauged, n_gauged=self.n_gauged + 1, newest_ms=at_ms)

    def with_unnamed(self, log_likelihood: NDArray[np.float64], at_ms: int) -> Self:
        """Return the grid after an unnamed grasp; arguments as `with_gauge`."""
        followed = _MEMORY * self.followed + _POWER * (log_likelihood - log_likelihood.max())
        n_followed = self.n_followed + 1
        return replace(self, followed=followed, n_followed=n_followed, newest_ms=at_ms)

    def at(self, start_ms: int) -> Self:
        """Return the grid for a grasp at a time: gauges count for a shift after its newest one."""
        if self.newest_ms is None or abs(start_ms - self.newest_ms) <= _LASTS_MS:
            return self
        return replace(self, gauged=np.zeros(()), n_gauged=0)

    def without_unnamed(self) -> Self:
        """Return the grid without the unnamed grasps."""
        return replace(self, followed=np.zeros(()), n_followed=0)

    def with_unnamed_as_gauge(self) -> Self:
        """Return the grid that keeps the evidence of unnamed grasps like a gauge."""
        if not self.n_followed:
            return self
        grid = replace(self, gauged=self.gauged + self.followed, n_gauged=self.n_gauged + 1)
        return grid.without_unnamed()

    @property
    def weight(self) -> NDArray[np.float64]:
        """(G, O) float64: probability of each hypothesis."""
        return np.asarray(np.exp(self.log_weight()), dtype=np.float64)

    @property
    def drift(self) -> Drift:
        """The mean."""
        weight = self.weight
        return Drift(
            gains=(float(np.exp(weight.sum(axis=1) @ self.log_gains)),),
            aperture_offset_m=self.offset_mm(weight)[0] * 1e-3,
        )

    @property
    def offset_sd_m(self) -> float:
        """Standard deviation of the offset of the opening in m."""
        return self.offset_mm(self.weight)[1] * 1e-3

    def offset_mm(self, weight: NDArray[np.float64]) -> tuple[float, float]:
        """Return mean and standard deviation of the opening's offset under weights (G, O)."""
        return moments(weight.sum(axis=0), self.offsets_mm)

    @property
    def unchanged(self) -> float:
        """Probability that gain and opening are those of teaching."""
        return float(self.weight[self._none])

    @property
    def values(self) -> dict[str, object]:
        """The drift, its uncertainty and the number of its grasps, as plain data."""
        drift = self.drift
        return {
            "gain": drift.gain,
            "gains": list(drift.gains),
            "aperture_mm": drift.aperture_offset_m * 1e3,
            "aperture_sd_mm": 1e3 * self.offset_sd_m,
            "unchanged": self.unchanged,
            "n_gauges": self.n_gauged,
            "n_grasps": self.n_followed,
        }

    @property
    def likely(self) -> bool:
        """Whether grasps have shown a drift, also where none was unlikely from the beginning."""
        before = 0.5 if self.zero is not None else type(self)(prior=self.prior).unchanged
        least = (1.0 - _LIKELY) * min(1.0, 2.0 * before)
        return self.n_followed + self.n_gauged > 0 and self.unchanged < least

    @property
    def _none(self) -> tuple[int, int]:
        """Index of no drift."""
        return int(np.argmin(np.abs(self.log_gains))), int(np.argmin(np.abs(self.offsets_mm)))

    def to_arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """Return the grid without the unnamed grasps as plain arrays."""
        return ArrayRecord.to_arrays(self.without_unnamed(), prefix)


def moments(weight: NDArray[np.float64], values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the mean and the standard deviation of values with weights."""
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (values - mean) ** 2))


def _axis(mean: float, reach: float, step: float) -> NDArray[np.float64]:
    """Return evenly spaced values about a mean, and 0."""
    n = max(2, int(np.ceil(reach / step - 1e-9)))
    values = mean + reach * np.arange(-n, n + 1) / n
    return np.unique(np.round(np.append(values, 0.0), 9))


@runtime_checkable
class DriftFollowing(Recognizer, Protocol):
    """A recognizer that follows the drift by unnamed grasps, and by gauges."""

    @property
    def grid(self) -> DriftGrid:
        """The drift since teaching by the grasps so far."""

    @property
    def zero(self) -> SelfZero | None:
        """Self-zero of the teaching; None without one."""

    @property
    def ends_early(self) -> bool:
        """Whether its answers to the first part of a ramp may end it."""

    def with_grid(self, grid: DriftGrid, /) -> Self:
        """Return a copy with another estimate of the drift."""

    def with_caution(self, caution: float, /) -> Self:
        """Return a copy that multiplies the odds of a new object by the caution."""

    def follow(self, grasp: Grasp, /) -> Self:
        """Return a copy after one more grasp of any object."""

    def gauge(self, label: str, grasps: Sequence[Grasp], /) -> Self:
        """Return a copy after a few grasps of a taught object; ValueError if they show nothing."""

    def without_gauges(self) -> Self:
        """Return a copy with the prior of the drift alone."""


_PRIOR_GROUPS = 3.0
"""Weight of the usual spread between days, in days: few of them show little."""
_LEAST_LOG_GAIN_SD, _LEAST_OFFSET_SD_MM = 0.03, 0.3
"""Least deviations of gain (log) and opening: a step of the grid, and how objects are placed."""


def learn_spread(grasps: Sequence[Grasp], groups: Sequence[str]) -> DriftPrior | None:
    """Return the prior of the drift on a new day or cell; None where the grasps show none.

    Parameters
    ----------
    grasps
        Labelled grasps of n_groups days or cells.
    groups
        Day and cell of each of them.
    """
    levels = load_levels(grasps, learn_rest(grasps))
    loads = np.stack([maps[:, -1].sum(axis=1) for maps in levels.maps], axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        values = np.stack([np.log(loads).mean(axis=1), sizes_mm(levels)[:, 1]], axis=1)
    labels, label = np.unique([g.label for g in grasps], return_inverse=True)
    names, group = np.unique(groups, return_inverse=True)
    usual = DriftPrior()
    sds = []
    for value, sd, least in (
        (values[:, 0], usual.log_gain_sd, _LEAST_LOG_GAIN_SD),
        (values[:, 1], usual.offset_sd_mm, _LEAST_OFFSET_SD_MM),
    ):
        known = np.isfinite(value) & levels.touched
        total, n = np.zeros((2, len(names), len(labels)))
        np.add.at(total, (group[known], label[known]), value[known])
        np.add.at(n, (group[known], label[known]), 1.0)
        mean = total / np.maximum(n, 1.0)
        n *= np.count_nonzero(n, axis=0) > 1  # an object of one group shows no difference
        rows = n.sum(axis=1) > 0
        freedom = np.count_nonzero(rows) - 1
        if freedom < 1:
            return None
        effect = day_effects(mean[rows], n[rows])
        # A new group differs from the mean of the taught ones by both their errors.
        between = float(effect @ effect) * (1.0 + 1.0 / len(effect))
        variance = (_PRIOR_GROUPS * sd**2 + between) / (_PRIOR_GROUPS + freedom)
        sds.append(max(least, float(np.sqrt(variance))))
    return DriftPrior(log_gain_sd=min(1.0, sds[0]), offset_sd_mm=min(30.0, sds[1]), unchanged=0.0)


def day_effects(mean: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the effect of each of D days, (D,) float64 with the mean 0, by least squares.

    Parameters
    ----------
    mean : (D, L)
        Mean value of each object on each day; any number where there is none.
    n : (D, L)
        Number of values; each day has some.
    """
    day, label = np.nonzero(n)
    weight = np.sqrt(n[day, label])
    design = np.concatenate([np.eye(len(n))[day], np.eye(n.shape[1])[label]], axis=1)
    effects = np.linalg.lstsq(design * weight[:, None], mean[day, label] * weight)[0][: len(n)]
    return np.asarray(effects - effects.mean(), dtype=np.float64)
