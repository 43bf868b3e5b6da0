"""Grid of drifts: hypotheses of gain and opening since teaching, each with its weight.

A self-zero gives the prior. A gauge multiplies the weights by the likelihood of its known object,
likelihood by the placing of objects. A grasp of an unnamed object multiplies them by its likelihood
under any taught object or a new one. This likelihood has a power, because grasps share errors. An
answer is the sum over the grid.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift.drift import Drift
from recognition.grasp import Grasp, SelfZero
from recognition.recognizer import Recognizer
from recognition.records import ArrayRecord, Numbers

_LOG_GAIN_STEP = 1 / 6
"""Largest step between two hypotheses of the logarithm of the gain."""
_OFFSET_STEP_MM = 0.5
"""Largest step between two hypotheses of the opening's zero in mm."""
_REACH = (8 / 3, 3.0)
"""Range of the hypotheses on each side in standard deviations: of gain, of opening."""
_POWER = 0.2
"""Power of the likelihood of an unnamed grasp."""
_MEMORY = 0.99
"""Share of the evidence of unnamed grasps kept after a further one, because drifts change."""
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

    def log_weight(self, unchanged: float | None = None) -> NDArray[np.float64]:
        """Return the logarithms of the weights of the hypotheses (G, O); the weights sum to 1.

        ``unchanged`` replaces that of the prior.
        """
        prior = self.prior
        share = prior.unchanged if unchanged is None else unchanged
        gain = -0.5 * ((self.log_gains - prior.log_gain) / prior.log_gain_sd) ** 2
        offset = -0.5 * ((self.offsets_mm - prior.offset_mm) / prior.offset_sd_mm) ** 2
        density = gain[:, None] + offset
        weight = (1.0 - share) * np.exp(density - logsumexp(density))
        weight[self._none] += share
        log_weight = np.log(np.maximum(weight, 1e-300)) + self.gauged + self.followed
        return np.asarray(log_weight - logsumexp(log_weight), dtype=np.float64)

    def with_gauge(self, log_likelihood: NDArray[np.float64], placing_mm: float) -> Self:
        """Return the grid after grasps of one known object.

        Parameters
        ----------
        log_likelihood : (G, O) or (G, 1)
            Of the grasps under each hypothesis.
        placing_mm
            Standard deviation of the opening on one object between placings in mm.
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
        return replace(self, gauged=self.gauged + total - total.max(), n_gauged=self.n_gauged + 1)

    def with_unnamed(self, log_likelihood: NDArray[np.float64]) -> Self:
        """Return the grid after an unnamed grasp; (G, O) or (G, 1), as `with_gauge`."""
        followed = _MEMORY * self.followed + _POWER * (log_likelihood - log_likelihood.max())
        return replace(self, followed=followed, n_followed=self.n_followed + 1)

    def without_unnamed(self) -> Self:
        """Return the grid without the unnamed grasps."""
        return replace(self, followed=np.zeros(()), n_followed=0)

    def with_unnamed_as_gauge(self) -> Self:
        """Return the grid that keeps the evidence of unnamed grasps like a gauge."""
        if not self.n_followed:
            return self
        known = replace(self, gauged=self.gauged + self.followed, n_gauged=self.n_gauged + 1)
        return known.without_unnamed()

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
        """Whether grasps have shown a drift."""
        return self.n_followed + self.n_gauged > 0 and self.unchanged < 1.0 - _LIKELY

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
