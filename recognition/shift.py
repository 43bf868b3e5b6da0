"""How good a recogniser is in a shift: objects in mixed order, each grasp tells of the drift."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from recognition.drift_following import DriftBelief
from recognition.grasp import Grasp
from recognition.metrics import wilson_interval
from recognition.recognizer import Recognizer

_BEFORE = 10


@runtime_checkable
class Following(Recognizer, Protocol):
    """A recogniser that learns of the drift from grasps that nobody named."""

    def following(self, grasps: Sequence[Grasp], /) -> "Following":
        """Return a copy that has seen some grasps of one object, whatever it was."""
        ...

    @property
    def belief(self) -> DriftBelief:
        """What is believed of the drift."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ShiftFigures:
    """What a following recogniser reached in a shift.

    Attributes
    ----------
    before
        Number of grasps of the shift that were seen before the first that counts.
    n
        Number of grasps that count.
    accuracy, interval
        Share of them whose likeliest label is right, and its 95 % Wilson interval.
    known_rejected
        Share of them with ``unknown`` above 0.5.
    """

    before: int
    n: int
    accuracy: float
    interval: tuple[float, float]
    known_rejected: float


def evaluate_shift(recognizer: object, grasps: Sequence[Grasp], seed: int) -> ShiftFigures | None:
    """Answer labelled grasps of taught objects in a mixed order, following them.

    None where the recogniser does not follow, or there are too few grasps.
    """
    if not isinstance(recognizer, Following) or len(grasps) <= _BEFORE:
        return None
    right, rejected = [], []
    for number, i in enumerate(np.random.default_rng(seed).permutation(len(grasps)).tolist()):
        grasp = grasps[i]
        if number >= _BEFORE:
            posterior = recognizer.posterior(grasp)
            right.append(posterior.best == grasp.label)
            rejected.append(posterior.unknown > 0.5)
        recognizer = recognizer.following([grasp])
    return ShiftFigures(
        before=_BEFORE,
        n=len(right),
        accuracy=sum(right) / len(right),
        interval=wilson_interval(sum(right), len(right)),
        known_rejected=sum(rejected) / len(right),
    )
