"""Fusion of the posteriors of several grasps of one object, and the stop rule of a sequence."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum, unique

import numpy as np
from scipy.special import expit, log_softmax, logit, logsumexp

from recognition.recognizer import UNKNOWN, Posterior

FLATTENING = 0.005
"""Share of the uniform distribution that each grasp gets before it is fused."""


def independent_share(n_grasps: int, dependence: float) -> float:
    """Return the weight of each of n grasps: together they weigh n / (1 + (n - 1) dependence)."""
    return 1.0 / (1.0 + (n_grasps - 1) * dependence)


MAX_UNKNOWN = 0.1
"""Largest probability of an untaught object with which a ramp or a sequence ends early: novelty
shows later than the name of a taught object (docs/explanations/sequences.md)."""
_MIN_UNKNOWN = 0.95
"""Least probability of an untaught object with which a sequence ends early."""
_MAX_UNKNOWN_LOGIT = 4.0
"""Largest magnitude of the log odds of an untaught object from one grasp: 1.8 and 98.2 %."""


@unique
class DecisionKind(Enum):
    """Kinds of decision after some grasps."""

    DECIDED = "decided"
    UNKNOWN = "unknown"
    CONTINUE = "continue"


@dataclass(frozen=True, slots=True, kw_only=True)
class Decision:
    """Decision after some grasps of one object."""

    kind: DecisionKind
    """Decided, unknown object, or one more grasp."""
    label: str
    """The object if decided, ``UNKNOWN`` if unknown, otherwise the likeliest so far."""
    probability: float
    """Probability that `label` is right."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StopRule:
    """Stop rule of a sequence of grasps.

    Raises
    ------
    ValueError
        A value is out of its range.
    """

    error_rate: float = 0.02
    """Largest probability of a wrong label, given a taught object, that ends a sequence. That of an
    untaught object must be at most `MAX_UNKNOWN`."""
    max_grasps: int = 4
    """Number of grasps after which the answer is given: `Posterior.name`."""

    def __post_init__(self) -> None:
        if not 0.0 < self.error_rate < 1.0:
            raise ValueError(f"error_rate is {self.error_rate}, must be above 0 and below 1")
        if self.max_grasps < 1:
            raise ValueError(f"max_grasps is {self.max_grasps}, must be at least 1")

    def suffices(self, fused: Posterior) -> bool:
        """Return whether a taught object is certain enough to end a ramp or a sequence early."""
        sure = 1.0 - float(fused.probability.max()) <= self.error_rate
        return sure and fused.unknown <= MAX_UNKNOWN and fused.name != UNKNOWN


def fuse(posteriors: Sequence[Posterior], *, dependence: float | None = None) -> Posterior:
    """Fuse the posteriors of several grasps of one object.

    Log posteriors over the uniform prior are summed, so that the prior counts once. The sum is
    tempered: n grasps count as n / (1 + (n - 1) dependence) independent ones. The default
    `dependence` is the mean of those of the posteriors. Grasps that contradict each other make
    an untaught object likelier. The order does not matter. One posterior alone is returned
    slightly flattened. Grasps without evidence count only where there are no others.

    Raises
    ------
    ValueError
        There is no posterior, the labels differ, or `dependence` is not from 0 to 1.
    """
    if not posteriors:
        raise ValueError("no posteriors to fuse: grasp at least once")
    posteriors = [p for p in posteriors if p.informed] or posteriors
    if dependence is None:
        dependence = float(np.mean(sorted(p.dependence for p in posteriors)))
    if not 0.0 <= dependence <= 1.0:
        raise ValueError(f"dependence is {dependence}, must be from 0 to 1")
    labels = posteriors[0].labels
    for p in posteriors:
        if p.labels != labels:
            raise ValueError(f"posteriors have different labels: {labels} and {p.labels}")
    n, n_labels = len(posteriors), len(labels)
    weight = independent_share(n, dependence)
    each = np.stack([p.probability for p in posteriors])
    flattened = (1.0 - FLATTENING) * each + FLATTENING / n_labels
    total = weight * np.sort(np.log(flattened * n_labels), axis=0).sum(axis=0)
    probability = np.exp(log_softmax(total))
    limit = float(expit(_MAX_UNKNOWN_LOGIT))
    log_odds = sorted(float(logit(np.clip(p.unknown, 1.0 - limit, limit))) for p in posteriors)
    agreement = float(logsumexp(total) - np.log(n_labels))
    unknown = float(expit(weight * sum(log_odds) - min(agreement, 0.0)))
    return Posterior(
        labels=labels,
        probability=probability / probability.sum(),
        unknown=unknown,
        dependence=dependence,
    )


def decide(posteriors: Sequence[Posterior], rule: StopRule) -> Decision:
    """Return the decision after the grasps so far: the object, an untaught one, or one more grasp.

    Raises ValueError without a posterior, or if the labels differ.
    """
    fused = fuse(posteriors)
    best = float(fused.probability.max())
    over = len(posteriors) >= rule.max_grasps or fused.unknown >= _MIN_UNKNOWN
    if not over and not rule.suffices(fused):
        return Decision(kind=DecisionKind.CONTINUE, label=fused.best, probability=best)
    if fused.name != UNKNOWN:
        return Decision(kind=DecisionKind.DECIDED, label=fused.name, probability=best)
    return Decision(kind=DecisionKind.UNKNOWN, label=UNKNOWN, probability=fused.name_probability)
