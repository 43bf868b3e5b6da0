"""Drift tracking: the drift since teaching, from grasps of objects that nobody named.

One cell has one drift, so the grasps of a shift show it together even where each leaves it open.
The evidence of one object is bounded twice: where a drift explains its grasps, a new object may as
well, so the evidence ends where a new object is as likely; and all sequences of one object, taught
or not, count as one. Only several different objects that agree make a drift likelier than none.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift.drift import Drift, DriftGrid
from recognition.grasp import Grasp
from recognition.recognizer import DEPENDENCE, Recognizer

_NEW = -4.0
"""Log likelihood of a new object, beside the mean of held-out grasps of taught ones: the drift that
suits it best leaves half of the objects never taught below -3.5, and 5 per cent of the taught."""
_MOST_PER_OBJECT = 9.0
"""Largest log likelihood ratio between two drifts that one object may give: a factor of e^9."""
_SAME_OBJECT = 12.0
"""Squared distance per axis up to which two grasps may be of one object: 95 per cent of the grasps
of one recorded object lie nearer to each other, 95 per cent of those of two beyond 20."""
_REMEMBERED = 20
"""Sequences that count; earlier ones are dropped, as drifts change."""
_SEQUENCES_OF_ONE = 3
"""Sequences of one object that are kept, the latest: a part that comes all day leaves the
others."""
_SAME_LOG_GAIN, _SAME_OFFSET_MM = 0.15, 0.75
"""Drifts within this logarithm of the gain and this offset in mm count as the same: no answer
changes by less."""
_CHANGE = 1e-4
"""Share of the probability that is kept for any drift at all, so that a later one is found too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftEstimate:
    """Estimate of the drift, from prior and tracked grasps.

    Attributes
    ----------
    drift
        The mean over the drifts that differ from the expected one.
    unchanged
        Probability that the drift is within 15 % of gain and 0.75 mm of the expected one: less
        changes no answer.
    expected
        The drift that was expected before any grasp was tracked.
    n_objects
        About how many different objects this rests on.
    """

    drift: Drift
    unchanged: float
    expected: Drift
    n_objects: int

    @property
    def likely(self) -> bool:
        """Whether a drift that differs from the expected one is likelier than not."""
        return self.unchanged < 0.5

    @property
    def present(self) -> Drift:
        """The drift if it is likely, otherwise the expected one."""
        return self.drift if self.likely else self.expected


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectDriftEvidence:
    """Evidence on the drift from the grasps of one object.

    Attributes
    ----------
    view
        The view that gave it; positions in two views cannot be compared.
    positions : (n, r) float64
        The grasps in the discriminant space of the view, as they were recorded.
    log_likelihood : (G, O) or (G, 1) float64
        Log likelihood of each drift, bounded.
    """

    view: str
    positions: NDArray[np.float64]
    log_likelihood: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("positions", "log_likelihood"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def same_as(self, other: "ObjectDriftEvidence") -> bool:
        """Whether both may be of one object: one grasp of each lies near one of the other."""
        if self.view != other.view:
            return False
        apart = self.positions[:, None] - other.positions
        return float((apart**2).mean(axis=-1).min()) < _SAME_OBJECT


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DriftTrack:
    """Drift evidence of the sequences of a shift so far.

    Attributes
    ----------
    prior
        Possible drifts before the first of them.
    seen
        The latest sequences, the newest last.
    alike : (n, n) bool
        Which of these may be of one object.
    mostly_taught
        Whether most of the objects are taken to be taught ones. Sequences of one object then count
        more than one alone, and none is dropped.
    """

    prior: DriftGrid
    seen: tuple[ObjectDriftEvidence, ...] = ()
    alike: NDArray[np.bool_] = field(default_factory=lambda: np.ones((0, 0), dtype=np.bool_))
    mostly_taught: bool = False

    def after(self, found: ObjectDriftEvidence) -> Self:
        """Return the track with one more sequence of grasps."""
        same = np.array([one.same_as(found) for one in self.seen], dtype=np.bool_)
        kept = np.arange(len(self.seen))
        if not self.mostly_taught:
            too_many = kept[same][: max(0, int(same.sum()) + 1 - _SEQUENCES_OF_ONE)]
            kept = np.setdiff1d(kept, too_many)[-_REMEMBERED + 1 :]
        alike = np.ones((len(kept) + 1, len(kept) + 1), dtype=np.bool_)
        alike[:-1, :-1] = self.alike[np.ix_(kept, kept)]
        alike[-1, :-1] = alike[:-1, -1] = same[kept]
        return replace(self, seen=(*(self.seen[i] for i in kept), found), alike=alike)

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weight of each sequence, (n,): all of one object together as one, or little more."""
        repeats = self.alike.sum(axis=1) - 1.0
        dependence = DEPENDENCE if self.mostly_taught else 1.0
        return np.asarray(1.0 / (1.0 + repeats * dependence), dtype=np.float64)

    @property
    def grid(self) -> DriftGrid:
        """Possible drifts with their probability, from prior and grasps."""
        after = self.prior.log_prior
        for weight, one in zip(self.weights, self.seen, strict=True):
            after = after + weight * one.log_likelihood
        after = after - logsumexp(after)
        kept = np.logaddexp(after + np.log1p(-_CHANGE), np.log(_CHANGE / after.size))
        return replace(self.prior, log_prior=np.asarray(kept, dtype=np.float64))

    @property
    def drift_estimate(self) -> DriftEstimate:
        """The drift that the grasps show."""
        grid, expected = self.grid, self.prior.likeliest
        log_gains, offsets_mm = np.log(grid.gains), grid.offsets_mm
        near_gain = np.abs(log_gains - np.log(expected.gain)) < _SAME_LOG_GAIN
        near_offset = np.abs(offsets_mm - expected.aperture_offset_m * 1e3) < _SAME_OFFSET_MM
        p = np.exp(grid.log_prior)
        other = np.where(near_gain[:, None] & near_offset, 0.0, p)
        changed = float(other.sum())
        p = other / changed if changed > 0.0 else p
        return DriftEstimate(
            drift=Drift(
                gain=float(np.exp(p.sum(axis=1) @ log_gains)),
                aperture_offset_m=float(p.sum(axis=0) @ offsets_mm) * 1e-3,
            ),
            unchanged=float(np.clip(1.0 - changed, 0.0, 1.0)),
            expected=expected,
            n_objects=round(float(self.weights.sum())),
        )


def bounded_log_likelihood(
    log_likelihood: NDArray[np.float64], bias: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (G, O) or (G, 1): bounded log likelihood of each drift, from grasps of one object.

    Parameters
    ----------
    log_likelihood : (n, G, O) or (n, G, 1)
        Of each grasp under each drift, whatever was held. Together they count like one.
    bias : (G, O) or (G, 1)
        Its mean in held-out grasps of taught objects without drift: a drift that those prefer to
        none gets no more likelihood.
    """
    middle = tuple(length // 2 for length in bias.shape)
    known = log_likelihood - np.maximum(bias, bias[middle])
    total = np.logaddexp(known, _NEW).mean(axis=0)
    return np.asarray(np.maximum(total - total.max(), -_MOST_PER_OBJECT), dtype=np.float64)


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
