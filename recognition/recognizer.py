"""Protocols of recognizers and trainers, and the posterior that a recognizer returns."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import Grasp, keep_array

UNKNOWN = "UNKNOWN"
"""The answer for an object that was never taught, or that cannot be separated from the others."""

LEAST_PROBABILITY = 0.5
"""Least probability of a name among the taught objects; with less the answer is ``UNKNOWN``."""

MOST_UNKNOWN = 0.5
"""Largest probability of a new object in an answer that names a taught one."""

_FAR = 3.0
"""Distance from a measured thickness that excludes a drawn one, in half widths of its 90 %
interval: five standard deviations."""

DEPENDENCE = 0.3
"""Correlation, 0 to 1, of the log evidence of two grasps of one object. They share the object, the
sensor and the errors of the recognizer (docs/explanations/sequences.md)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Posterior:
    """Posterior probabilities of the taught objects after one grasp or several fused ones."""

    labels: tuple[str, ...]
    """The taught objects."""
    probability: NDArray[np.float64]
    """(n_labels,) float64: calibrated probability of each label, given that the object was taught.
    Sums to 1."""
    unknown: float
    """float: probability from 0 to 1 that the object was never taught."""
    dependence: float = DEPENDENCE
    """Correlation with further grasps of the object, 0 to 1; fusion weighs grasps by it."""
    drawn_m: tuple[float, ...] = ()
    """Thicknesses in m of the likeliest object along the closing axis by its drawing, in present
    readings of the opening. Empty without a drawing, or if the zero of the opening is unknown."""
    informed: bool = True
    """False for a grasp without evidence: fusion with other grasps leaves it out."""

    def __post_init__(self) -> None:
        p = keep_array(self, "probability", self.probability, np.float64)
        if p.shape != (len(self.labels),) or not np.all(np.isfinite(p)) or np.any(p < 0):
            raise ValueError(f"probabilities {p} do not fit the {len(self.labels)} labels")
        if UNKNOWN in self.labels:
            raise ValueError(f"{UNKNOWN} is the answer for untaught objects, not a label")
        if abs(float(p.sum()) - 1.0) > 1e-6:
            raise ValueError(f"probabilities sum to {p.sum()}, not to 1")
        if not 0.0 <= self.unknown <= 1.0:
            raise ValueError(f"unknown is {self.unknown}, not from 0 to 1")
        if not 0.0 <= self.dependence <= 1.0:
            raise ValueError(f"dependence is {self.dependence}, not from 0 to 1")

    @property
    def best(self) -> str:
        """The likeliest of the taught labels."""
        return self.labels[int(np.argmax(self.probability))]

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of each taught label and, last, of ``UNKNOWN``; they sum to 1."""
        known = ((1.0 - self.unknown) * self.probability).tolist()
        return {**dict(zip(self.labels, known, strict=True)), UNKNOWN: self.unknown}

    @classmethod
    def uninformed(cls, labels: tuple[str, ...]) -> "Posterior":
        """Return the posterior of a grasp without evidence: even probabilities, unknown is 1."""
        even = np.full(len(labels), 1.0 / len(labels))
        return cls(labels=labels, probability=even, unknown=1.0, informed=False)

    def with_size(self, low_m: float, high_m: float) -> "Posterior":
        """Return the posterior after a measured thickness with its 90 % interval in m.

        If this excludes all drawn thicknesses, the object was never taught: unknown is 1.
        """
        middle_m, reach_m = 0.5 * (low_m + high_m), 0.5 * _FAR * (high_m - low_m)
        far = bool(self.drawn_m) and min(abs(d - middle_m) for d in self.drawn_m) > reach_m
        return replace(self, unknown=1.0) if far else self

    @property
    def name(self) -> str:
        """The answer: the likeliest label, or ``UNKNOWN``.

        A name needs a probability of at least `LEAST_PROBABILITY` among the taught objects, and one
        of at most `MOST_UNKNOWN` for a new object. There is no other rule.
        """
        sure = float(self.probability.max()) >= LEAST_PROBABILITY
        return self.best if sure and self.unknown <= MOST_UNKNOWN else UNKNOWN

    @property
    def name_probability(self) -> float:
        """Probability of the name, see `answer_probability`."""
        return answer_probability(self.name, self.probabilities)


def answer_probability(label: str, probabilities: Mapping[str, float]) -> float:
    """Return the probability of an answer, from that of each label and of ``UNKNOWN``.

    For ``UNKNOWN`` it is that of not being the likeliest object: a part may look like several.
    """
    likeliest = max([p for taught, p in probabilities.items() if taught != UNKNOWN], default=0.0)
    return 1.0 - likeliest if label == UNKNOWN else likeliest


class Recognizer(Protocol):
    """A taught recognizer."""

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects, sorted."""

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp; ValueError for pads other than the taught ones."""

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the taught recognizer as plain arrays (numbers and strings, no objects)."""

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises ValueError that names a missing or wrong array."""


class Trainer(Protocol):
    """Teaches one kind of recognizer."""

    @property
    def name(self) -> str:
        """Name in tables, models and on the command line."""

    @property
    def uses_aperture(self) -> bool:
        """Whether the opening between the fingers is used."""

    def fit(self, grasps: Sequence[Grasp]) -> Recognizer:
        """Learn from labelled grasps. Raises ValueError if they are too few."""
