"""Estimate of the drift since teaching: a Gaussian that each grasp of a likely object narrows.

One estimate serves a gauge, whose object is known, and the grasps of a shift, whose objects are
known with the probability that the recogniser gives them, as in probabilistic data association
(Bar-Shalom and Tse, "Tracking in a cluttered environment with probabilistic data association",
1975): what an object shows holds with its probability, and with the rest it shows nothing. The
posterior of the drift is integrated by importance sampling.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import expit, logsumexp

from recognition.drift.drift import NO_DRIFT, Drift
from recognition.grasp import Grasp
from recognition.recognizer import Recognizer

LOG_GAIN_SD = 0.25
"""Standard deviation of the logarithm of a pad's gain from day to day: tens of per cent."""
OFFSET_SD_MM = 3.0
"""Standard deviation of the zero of the opening from day to day in mm."""
_PLACING_LOG_GAIN_SD = 0.1
"""Standard deviation of the logarithm of the load of one object between placings."""
_PLACING_OFFSET_SD_MM = 1.0
"""Standard deviation of the opening on one object between placings in mm."""
_UNCHANGED = 0.997
"""Prior probability that the sensors are as they are expected."""
_LEAST_OBJECTS = 3
"""Fewest different objects that show a drift, where as many were taught: how a single one lies in
the fingers looks like a drift."""
_SAMPLES = 4096
"""Samples of the integration: the mean is exact to some per cent of its deviation."""
_PROPOSAL_SD = 2.0
"""Deviation of the samples about a first estimate, in its deviations."""
_REMEMBERED = 5
"""Latest sequences of one object that count: drifts change."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriftMeasurement:
    """Drift by the grasps of one sequence, if they were of one taught object."""

    label: str
    """The object."""
    probability: float
    """Probability that it was this object, 0 to 1."""
    values: NDArray[np.float64]
    """(d,) float64: logarithm of the gain of each gripping pad; then the offset of the opening in
    mm, where the grasps show it."""
    covariance: NDArray[np.float64]
    """(d, d) float64: covariance of the values, from the variation of such grasps."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriftEstimate:
    """Gaussian estimate of the drift."""

    pads: tuple[int, ...]
    """The gripping pads, by their numbers in the layout."""
    n_pads: int
    """Number of pads of the layout; pads that do not grip are taken to have the mean gain."""
    expected: Drift
    """The drift that is expected before any grasp."""
    mean: NDArray[np.float64]
    """(P + 1,) float64: logarithm of the gain of each gripping pad, and the offset of the opening
    in mm."""
    covariance: NDArray[np.float64]
    """(P + 1, P + 1) float64: covariance of the mean."""
    n_labels: int
    """Number of taught objects."""
    unchanged: float = _UNCHANGED
    """Probability that the sensors are as expected."""
    measured: Mapping[str, tuple[DriftMeasurement, ...]] = field(default_factory=dict)
    """What all sequences of one object show together, by object. However often an object comes, it
    counts as one: how it lies in the fingers is its own, not the sensors', and a new object may
    look like a taught one under a drift."""

    @classmethod
    def before(
        cls, pads: tuple[int, ...], n_pads: int, *, n_labels: int, expected: Drift = NO_DRIFT
    ) -> Self:
        """Return the estimate before any grasp."""
        return cls(
            pads=pads,
            n_pads=n_pads,
            expected=expected,
            mean=_vector(expected, pads),
            covariance=_diagonal(len(pads), LOG_GAIN_SD, OFFSET_SD_MM),
            n_labels=n_labels,
        )

    @property
    def drift(self) -> Drift:
        """The mean."""
        return self.drift_of(self.mean)

    @property
    def log_gain_sd(self) -> float:
        """Largest standard deviation of the logarithm of a gain."""
        return float(np.sqrt(np.diag(self.covariance)[:-1].max()))

    @property
    def offset_sd_m(self) -> float:
        """Standard deviation of the offset of the opening in m."""
        return float(np.sqrt(self.covariance[-1, -1])) * 1e-3

    @property
    def n_objects(self) -> int:
        """Number of different objects that were likely in one of their sequences."""
        return sum(
            max(one.probability for one in of_one) > 0.5 for of_one in self.measured.values()
        )

    @property
    def likely(self) -> bool:
        """Whether a drift other than the expected one is likelier than not, by several objects."""
        return self.unchanged < 0.5 and self.n_objects >= min(_LEAST_OBJECTS, self.n_labels)

    @property
    def present(self) -> Drift:
        """The mean if a drift is likely, otherwise the expected drift."""
        return self.drift if self.likely else self.expected

    def drift_of(self, values: NDArray[np.float64]) -> Drift:
        """Return a drift from the logarithms of gains and an offset in mm, within what may be."""
        log_gains = np.clip(values[:-1], np.log(0.2), np.log(5.0))
        gains = np.full(self.n_pads, np.exp(log_gains.mean()))
        gains[list(self.pads)] = np.exp(log_gains)
        offset_mm = float(np.clip(values[-1], -100.0, 100.0))
        return Drift(gains=tuple(gains.tolist()), aperture_offset_m=offset_mm * 1e-3)

    def after(self, measured: Sequence[DriftMeasurement]) -> Self:
        """Return the estimate after the grasps of one sequence.

        Parameters
        ----------
        measured
            One measurement for each object that it may have been; the rest of the probability is
            that of a new object.
        """
        every = dict(self.measured)
        for one in measured:
            every[one.label] = (*every.get(one.label, ()), one)[-_REMEMBERED:]
        objects = [_together(every[label]) for label in sorted(every)]
        before = self.before(self.pads, self.n_pads, n_labels=self.n_labels, expected=self.expected)
        about, around = before.mean, before.covariance
        for one in objects:
            about, around = _narrowed(about, around, one)
        return replace(before.integrated(objects, about, around), measured=every)

    def integrated(
        self,
        objects: Sequence[DriftMeasurement],
        about: NDArray[np.float64],
        around: NDArray[np.float64],
    ) -> Self:
        """Return mean, covariance and probability of no drift after some objects.

        Half of the samples are drawn from the prior, half from a wider Gaussian about a first
        estimate.
        """
        normal = _normal_samples(len(self.mean))
        half = len(normal) // 2
        near = _Gaussian(about, _PROPOSAL_SD**2 * around)
        prior = _Gaussian(self.mean, self.covariance)
        drifts = np.concatenate([prior.scaled(normal[:half]), near.scaled(normal[half:])])
        log_prior = prior.log_density(drifts)
        log_drawn = np.logaddexp(log_prior, near.log_density(drifts)) - np.log(2.0)
        shown = sum(self._log_likelihood(one, drifts) for one in objects)
        log_weight = log_prior + shown - log_drawn
        none = float(sum(self._log_likelihood(one, self.mean[None])[0] for one in objects))
        drifted = float(logsumexp(log_weight)) - np.log(len(drifts))
        weight = np.exp(log_weight - logsumexp(log_weight))
        mean = weight @ drifts
        seen = max((len(one.values) for one in objects), default=0)
        mean[seen:] = self.mean[seen:]
        off = drifts - mean
        log_odds = np.log(_UNCHANGED / (1.0 - _UNCHANGED)) + none - drifted
        return replace(
            self,
            mean=mean,
            covariance=(weight[:, None] * off).T @ off + 1e-6 * np.eye(len(mean)),
            unchanged=float(expit(log_odds)),
        )

    def _log_likelihood(
        self, one: DriftMeasurement, drifts: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (n,): log likelihood of drifts by one object, against one that shows nothing."""
        seen, noise = len(one.values), _noise(one, len(self.pads))
        under = _Gaussian(one.values, noise).log_density(drifts[:, :seen])
        whatever = _Gaussian(one.values, self.covariance[:seen, :seen] + noise).log_density(
            self.mean[None, :seen]
        )
        p = min(max(one.probability, 1e-6), 1.0 - 1e-6)
        found: NDArray[np.float64] = np.logaddexp(np.log1p(-p), np.log(p) + under - whatever)
        return found


class _Gaussian:
    """Normal distribution in a few dimensions."""

    def __init__(self, mean: NDArray[np.float64], covariance: NDArray[np.float64]) -> None:
        self._mean = mean
        self._lower = np.linalg.cholesky(covariance)

    def scaled(self, normal: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return samples (n, d) from standard normal ones."""
        scaled: NDArray[np.float64] = self._mean + normal @ self._lower.T
        return scaled

    def log_density(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n,), without the constant that all have."""
        whitened = solve_triangular(self._lower, (points - self._mean).T, lower=True)
        volume = float(np.log(np.diag(self._lower)).sum())
        return np.asarray(-0.5 * (whitened**2).sum(axis=0) - volume, dtype=np.float64)


@cache
def _normal_samples(n_dimensions: int) -> NDArray[np.float64]:
    """Return (n, d) standard normal samples, the same each time."""
    return np.random.default_rng(0).standard_normal((_SAMPLES, n_dimensions))


def _noise(one: DriftMeasurement, n_pads: int) -> NDArray[np.float64]:
    """Return the covariance of a measurement, with how objects lie from placing to placing."""
    seen = len(one.values)
    placing = _diagonal(n_pads, _PLACING_LOG_GAIN_SD, _PLACING_OFFSET_SD_MM)
    return one.covariance + placing[:seen, :seen]


def _narrowed(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], one: DriftMeasurement
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean and covariance after a measurement, if it holds: a step of a Kalman filter.

    Its noise is the larger, the less probable it is.
    """
    seen = len(one.values)
    noise = _noise(one, len(mean) - 1) / max(one.probability, 1e-3)
    gain = covariance[:, :seen] @ np.linalg.inv(covariance[:seen, :seen] + noise)
    narrowed = covariance - gain @ covariance[:seen]
    return mean + gain @ (one.values - mean[:seen]), (narrowed + narrowed.T) / 2


def _together(of_one: Sequence[DriftMeasurement]) -> DriftMeasurement:
    """Return what several sequences of one object show: their mean, with the spread of one."""
    weight = np.array([one.probability for one in of_one])
    share = weight / max(float(weight.sum()), 1e-12)
    seen = min(len(one.values) for one in of_one)
    return DriftMeasurement(
        label=of_one[0].label,
        probability=float(weight.mean()),
        values=share @ np.array([one.values[:seen] for one in of_one]),
        covariance=np.tensordot(
            share, np.array([one.covariance[:seen, :seen] for one in of_one]), axes=1
        ),
    )


@runtime_checkable
class DriftTracking(Recognizer, Protocol):
    """A recogniser that tracks the drift from grasps of objects that nobody named."""

    def track_drift(self, grasps: Sequence[Grasp], /) -> "DriftTracking":
        """Return a copy whose drift estimate includes grasps of one object, whatever it was."""
        ...

    @property
    def drift_estimate(self) -> DriftEstimate:
        """The drift that the tracked grasps show."""
        ...


def _vector(drift: Drift, pads: tuple[int, ...]) -> NDArray[np.float64]:
    return np.append(np.log(drift.gains_of(pads)), drift.aperture_offset_m * 1e3)


def _diagonal(n_pads: int, log_gain_sd: float, offset_sd_mm: float) -> NDArray[np.float64]:
    return np.diag([log_gain_sd**2] * n_pads + [offset_sd_mm**2])
