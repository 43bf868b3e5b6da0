"""Recogniser `shrinkage_lda`, a plain reference: one discriminant on the features of `force_ramp`.

It has one temperature, and one limit of the distance to the nearest object beyond which a grasp is
more likely of a new one. Both are fitted on grasps that are held out in blocks of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from recognition.features.groups import FEATURE_VERSION, features_of
from recognition.grasp import Grasp, by_label
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import Rest, learn_rest
from recognition.recognizer import Posterior
from recognition.records import TaughtRecord
from recognition.statistics.calibration import (
    KNOWN_KEPT,
    blocked_folds,
    check_temperature,
    fit_temperature,
    to_probability,
)
from recognition.statistics.lda import LinearDiscriminant, fit_lda

_FOLDS = 3
"""Blocks in time, each held out in turn."""
_SHARPNESS = 4.0
"""Log odds of a new object for each unit of the logarithm of the squared distance."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShrinkageLda(TaughtRecord):
    """A taught discriminant."""

    version: ClassVar[int] = FEATURE_VERSION
    labels: tuple[str, ...]
    """The taught objects, sorted."""
    uses_aperture: bool
    """Whether the opening between the fingers is used."""
    rest: Rest
    """The untouched pads."""
    fill: NDArray[np.float64]
    """(F,) float64: replacement of an unknown feature."""
    discriminant: LinearDiscriminant
    """The classes."""
    temperature: float
    """Log likelihoods are divided by it."""
    limit: float
    """Squared distance to the nearest object above which a grasp is more likely of a new one."""

    def __post_init__(self) -> None:
        check_temperature(self.temperature)
        squared = self.discriminant.distances(self.fill[None])
        if squared.shape != (1, len(self.labels)) or not np.all(np.isfinite(squared)):
            raise ValueError(f"the arrays of the model do not fit its {len(self.labels)} labels")

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp. Raises ValueError for pads other than the taught ones.

        A grasp that never touched both pads gives even probabilities and is unknown with 1.
        """
        levels = load_levels([grasp], self.rest)
        features = features_of(levels, self.rest, opening=self.uses_aperture)
        if not levels.touched[0]:
            return Posterior.uninformed(self.labels)
        squared = self.discriminant.distances(np.where(np.isnan(features), self.fill, features))
        return Posterior(
            labels=self.labels,
            probability=to_probability(-0.5 * squared, self.temperature)[0],
            unknown=float(expit(_SHARPNESS * np.log(max(squared.min(), 1e-12) / self.limit))),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ShrinkageLdaTrainer:
    """Teaches the plain reference."""

    name: ClassVar[str] = "shrinkage_lda"
    use_aperture: bool = True

    @property
    def uses_aperture(self) -> bool:
        """Whether the opening between the fingers is used."""
        return self.use_aperture

    def fit(self, grasps: Sequence[Grasp]) -> ShrinkageLda:
        """Teach with labelled grasps; those that never touched both pads are left out.

        Raises ValueError if an object has too few grasps left.
        """
        ordered = [grasp for group in by_label(grasps).values() for grasp in group]
        rest = learn_rest(ordered)
        levels = load_levels(ordered, rest)
        names = np.array([grasp.label for grasp in ordered])
        labels, classes = np.unique(names[levels.touched], return_inverse=True)
        if lost := sorted(set(names.tolist()) - set(labels.tolist())):
            raise ValueError(f"no grasp of {', '.join(lost)} touched both pads: press harder")
        features = features_of(levels.take(levels.touched), rest, opening=self.use_aperture)
        known = np.isfinite(features)
        fill = np.where(known, features, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        features = np.where(known, features, fill)
        discriminant = fit_lda(features, classes, len(labels))
        folds = blocked_folds(classes, _FOLDS)
        squared = [
            fit_lda(features[~held], classes[~held], len(labels)).distances(features[held])
            for held in folds
        ]
        scores = -0.5 * np.concatenate(squared)
        held_classes = np.concatenate([classes[held] for held in folds])
        nearest = -2.0 * scores.max(axis=1)
        return ShrinkageLda(
            labels=tuple(labels.tolist()),
            uses_aperture=self.use_aperture,
            rest=rest,
            fill=fill,
            discriminant=discriminant,
            temperature=fit_temperature(scores, held_classes),
            limit=max(float(np.quantile(nearest, KNOWN_KEPT)), 1e-9),
        )
