"""Several grasps -> one answer: fuse their posteriors, and say when to stop."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, unique

import numpy as np
from scipy.special import expit, log_softmax, logit, logsumexp

from recognition.dependence import evidence, independent_share
from recognition.recognizer import UNKNOWN, Posterior

_MAX_UNKNOWN_LOGIT = 4.0


@unique
class DecisionKind(Enum):
    """What follows from the grasps so far."""

    DECIDED = "decided"
    UNKNOWN = "unknown"
    CONTINUE = "continue"


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """What follows from the grasps so far.

    Attributes
    ----------
    kind
        Decided, unknown object, or one more grasp.
    label
        The object where decided, ``UNKNOWN`` where unknown, the likeliest so far otherwise.
    probability
        Probability of what `label` says.
    """

    kind: DecisionKind
    label: str
    probability: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StopRule:
    """When there are grasps enough.

    Attributes
    ----------
    error_rate
        A label is given as soon as the probability that it is wrong is at most this.
    max_grasps
        Number of grasps after which the answer must be given.
    min_grasps
        Number of grasps before which none is given.
    max_unknown
        Largest probability of an untaught object with which a label is given.
    min_unknown
        Probability of an untaught object from which the search ends before `max_grasps`.
    min_probability
        Smallest probability with which a label is given after the last grasp.

    Raises
    ------
    ValueError
        A value is outside of its range.
    """

    error_rate: float = 0.01
    max_grasps: int = 5
    min_grasps: int = 1
    max_unknown: float = 0.5
    min_unknown: float = 0.95
    min_probability: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.error_rate < 1.0:
            raise ValueError(f"error_rate is {self.error_rate}, must be above 0 and below 1")
        if not 1 <= self.min_grasps <= self.max_grasps:
            raise ValueError(
                f"min_grasps is {self.min_grasps}, must be from 1 to max_grasps {self.max_grasps}"
            )
        for name in ("max_unknown", "min_unknown", "min_probability"):
            value = getattr(self, name)
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} is {value}, must be from 0 to 1")
        if self.min_unknown < self.max_unknown:
            raise ValueError(
                f"min_unknown {self.min_unknown} is below max_unknown {self.max_unknown}: "
                "a grasp could call for a label and for UNKNOWN at once"
            )


def fuse(posteriors: Sequence[Posterior], *, dependence: float | None = None) -> Posterior:
    """Fuse the posteriors of several grasps of one object.

    Log posteriors over the uniform prior are summed, so that the prior counts once, and the sum is
    tempered as if n grasps were n / (1 + (n - 1) dependence) independent ones. Without a
    `dependence` it is the mean of what the posteriors say of theirs. Grasps that contradict each
    other speak for an untaught object. The order does not matter; one posterior alone comes back
    with its order of labels, slightly flattened.

    Raises
    ------
    ValueError
        There is no posterior, the labels differ, or `dependence` is not from 0 to 1.
    """
    if not posteriors:
        raise ValueError("no posteriors to fuse: grasp at least once")
    if dependence is None:
        dependence = float(np.mean(sorted(p.dependence for p in posteriors)))
    if not 0.0 <= dependence <= 1.0:
        raise ValueError(f"dependence is {dependence}, must be from 0 to 1")
    labels = posteriors[0].labels
    for p in posteriors:
        if p.labels != labels:
            raise ValueError(f"posteriors speak of different labels: {labels} and {p.labels}")
    n, n_labels = len(posteriors), len(labels)
    weight = independent_share(n, dependence)
    told = evidence(np.stack([p.probability for p in posteriors]))
    total = weight * np.sort(told, axis=0).sum(axis=0)
    probability = np.exp(log_softmax(total))
    limit = float(expit(_MAX_UNKNOWN_LOGIT))
    doubts = sorted(float(logit(np.clip(p.unknown, 1.0 - limit, limit))) for p in posteriors)
    agreement = float(logsumexp(total) - np.log(n_labels))
    unknown = float(expit(weight * sum(doubts) - min(agreement, 0.0)))
    return Posterior(
        labels=labels,
        probability=probability / probability.sum(),
        unknown=unknown,
        dependence=dependence,
    )


def decide(posteriors: Sequence[Posterior], rule: StopRule) -> Decision:
    """Say whether the grasps so far name the object, show an untaught one, or call for another.

    Raises ValueError where there is no posterior or the labels differ.
    """
    fused = fuse(posteriors)
    n, best = len(posteriors), float(fused.probability.max())
    if n >= rule.min_grasps:
        if fused.unknown <= rule.max_unknown and 1.0 - best <= rule.error_rate:
            return Decision(kind=DecisionKind.DECIDED, label=fused.best, probability=best)
        if fused.unknown >= rule.min_unknown:
            return _unknown(fused.unknown)
    if n < rule.max_grasps:
        return Decision(kind=DecisionKind.CONTINUE, label=fused.best, probability=best)
    if fused.unknown <= rule.max_unknown and best >= rule.min_probability:
        return Decision(kind=DecisionKind.DECIDED, label=fused.best, probability=best)
    return _unknown(max(fused.unknown, 1.0 - best))


def _unknown(probability: float) -> Decision:
    return Decision(kind=DecisionKind.UNKNOWN, label=UNKNOWN, probability=probability)
