"""Grasps of objects that nobody named -> what drifted since teaching.

One cell has one drift, so the grasps of a shift show it together even where each leaves it open.
What one object can say is bounded twice: a drift that explains it may as well be a new object, so
its evidence ends where a new object is as likely; and all sequences of one object, known or not,
count as one. Only several different objects that agree make a drift likelier than none.
"""

from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift import Drift, DriftGrid
from recognition.recognizer import DEPENDENCE

_NEW = -4.0
"""Log likelihood of a new object, beside the mean of held-out grasps of taught ones: the drift that
suits it best leaves half of the objects never taught below -3.5, and 5 per cent of the taught."""
_MOST_PER_OBJECT = 9.0
"""Logarithm of the most that one object may speak for one drift and against another."""
_SAME_OBJECT = 12.0
"""Squared distance per axis up to which two grasps may be of one object: 95 per cent of the grasps
of one recorded object lie nearer to each other, 95 per cent of those of two beyond 20."""
_REMEMBERED = 20
"""Sequences that count; what came before them is forgotten, as drifts change."""
_SEQUENCES_OF_ONE = 3
"""Of one object so many, the latest: a part that comes all day does not push the others out."""
_SAME_LOG_GAIN, _SAME_OFFSET_MM = 0.15, 0.75
"""Drifts that differ by less are not told apart where a drift is said."""
_CHANGE = 1e-4
"""Share of the probability that is kept for any drift at all, so that a later one is found too."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftBelief:
    """What is believed of the drift.

    Attributes
    ----------
    drift
        The mean over the drifts that differ from the expected one.
    unchanged
        Probability that the drift is within 15 % of gain and 0.75 mm of the expected one: less
        changes no answer.
    expected
        The drift that was expected before any grasp was followed.
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
class SeenObject:
    """What the grasps of one object said.

    Attributes
    ----------
    view
        Which view looked at them; places in two views cannot be compared.
    places : (n, r) float64
        The grasps in the discriminant space of the view, as they were recorded.
    told : (G, O) or (G, 1) float64
        Log likelihood of each drift, bounded.
    """

    view: str
    places: NDArray[np.float64]
    told: NDArray[np.float64]

    def __post_init__(self) -> None:
        for name in ("places", "told"):
            array = np.array(getattr(self, name), dtype=np.float64)
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def same_as(self, other: "SeenObject") -> bool:
        """Whether both may be of one object: one grasp of each looks like one of the other."""
        if self.view != other.view:
            return False
        apart = self.places[:, None] - other.places
        return float((apart**2).mean(axis=-1).min()) < _SAME_OBJECT


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FollowedShift:
    """What the grasps of a shift have shown so far.

    Attributes
    ----------
    prior
        What the drift might be before the first of them.
    seen
        The latest sequences, the newest last.
    alike : (n, n) bool
        Which of these may be of one object.
    trusted
        Whether somebody says that most of the objects were taught. Sequences of one object then
        tell more than one alone, and none is forgotten.
    """

    prior: DriftGrid
    seen: tuple[SeenObject, ...] = ()
    alike: NDArray[np.bool_] = field(default_factory=lambda: np.ones((0, 0), dtype=np.bool_))
    trusted: bool = False

    def after(self, found: SeenObject) -> Self:
        """Return what is known with one more sequence of grasps."""
        same = np.array([one.same_as(found) for one in self.seen], dtype=np.bool_)
        kept = np.arange(len(self.seen))
        if not self.trusted:
            too_many = kept[same][: max(0, int(same.sum()) + 1 - _SEQUENCES_OF_ONE)]
            kept = np.setdiff1d(kept, too_many)[-_REMEMBERED + 1 :]
        alike = np.ones((len(kept) + 1, len(kept) + 1), dtype=np.bool_)
        alike[:-1, :-1] = self.alike[np.ix_(kept, kept)]
        alike[-1, :-1] = alike[:-1, -1] = same[kept]
        return replace(self, seen=(*(self.seen[i] for i in kept), found), alike=alike)

    @property
    def weights(self) -> NDArray[np.float64]:
        """How much each sequence counts, (n,): all of one object as one, or little more."""
        repeats = self.alike.sum(axis=1) - 1.0
        dependence = DEPENDENCE if self.trusted else 1.0
        return np.asarray(1.0 / (1.0 + repeats * dependence), dtype=np.float64)

    @property
    def grid(self) -> DriftGrid:
        """What the drift may be, by prior and grasps."""
        after = self.prior.log_prior
        for weight, one in zip(self.weights, self.seen, strict=True):
            after = after + weight * one.told
        after = after - logsumexp(after)
        kept = np.logaddexp(after + np.log1p(-_CHANGE), np.log(_CHANGE / after.size))
        return replace(self.prior, log_prior=np.asarray(kept, dtype=np.float64))

    @property
    def belief(self) -> DriftBelief:
        """What is believed of the drift."""
        grid, expected = self.grid, self.prior.likeliest
        log_gains, offsets_mm = np.log(grid.gains), grid.offsets_mm
        near_gain = np.abs(log_gains - np.log(expected.gain)) < _SAME_LOG_GAIN
        near_offset = np.abs(offsets_mm - expected.aperture_offset_m * 1e3) < _SAME_OFFSET_MM
        p = np.exp(grid.log_prior)
        other = np.where(near_gain[:, None] & near_offset, 0.0, p)
        changed = float(other.sum())
        p = other / changed if changed > 0.0 else p
        return DriftBelief(
            drift=Drift(
                gain=float(np.exp(p.sum(axis=1) @ log_gains)),
                aperture_offset_m=float(p.sum(axis=0) @ offsets_mm) * 1e-3,
            ),
            unchanged=float(np.clip(1.0 - changed, 0.0, 1.0)),
            expected=expected,
            n_objects=round(float(self.weights.sum())),
        )


def what_it_told(
    log_likelihood: NDArray[np.float64], bias: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (G, O) or (G, 1): what the grasps of one object tell of each drift.

    Parameters
    ----------
    log_likelihood : (n, G, O) or (n, G, 1)
        Of each grasp under each drift, whatever was held. Together they count like one.
    bias : (G, O) or (G, 1)
        Its mean in held-out grasps of taught objects without drift: a drift that those prefer to
        none is not believed more.
    """
    middle = tuple(length // 2 for length in bias.shape)
    known = log_likelihood - np.maximum(bias, bias[middle])
    told = np.logaddexp(known, _NEW).mean(axis=0)
    return np.asarray(np.maximum(told - told.max(), -_MOST_PER_OBJECT), dtype=np.float64)
