"""Recogniser `shrinkage_lda`, a plain reference: one discriminant on the features of `force_ramp`.

It has one temperature, and one limit of the distance to the nearest object beyond which a grasp is
more likely of a new one. Both are fitted on grasps that are held out in blocks of time.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from recognition.features.groups import FEATURE_VERSION, check_version, features_of
from recognition.grasp import Grasp, by_label
from recognition.ramp.levels import load_levels
from recognition.ramp.ramp import Rest, learn_rest
from recognition.recognizer import Posterior
from recognition.statistics.calibration import (
    KNOWN_KEPT,
    blocked_folds,
    fit_temperature,
    kept_temperature,
    to_probability,
)
from recognition.statistics.lda import LinearDiscriminant, fit_lda

_FOLDS = 3
"""Blocks in time, each held out in turn."""
_SHARPNESS = 4.0
"""Log odds of a new object for each unit of the logarithm of the squared distance."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShrinkageLda:
    """A taught discriminant."""

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

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the taught recogniser as plain arrays."""
        return {
            "feature_version": np.array(FEATURE_VERSION),
            "labels": np.array(self.labels),
            "uses_aperture": np.array(self.uses_aperture),
            "fill": self.fill,
            "temperature": np.array(self.temperature),
            "limit": np.array(self.limit),
            **self.rest.to_arrays(),
            **self.discriminant.to_arrays("lda_"),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises ValueError that names a missing or wrong array."""
        try:
            check_version(arrays)
            taught = cls(
                labels=tuple(str(label) for label in arrays["labels"]),
                uses_aperture=bool(arrays["uses_aperture"]),
                rest=Rest.from_arrays(arrays),
                fill=arrays["fill"],
                discriminant=LinearDiscriminant.from_arrays(arrays, "lda_"),
                temperature=kept_temperature(arrays["temperature"]),
                limit=float(arrays["limit"]),
            )
        except KeyError as missing:
            raise ValueError(f"the model lacks the array {missing}") from missing
        squared = taught.discriminant.distances(taught.fill[None])
        if squared.shape != (1, len(taught.labels)) or not np.all(np.isfinite(squared)):
            raise ValueError(f"the arrays of the model do not fit its {len(taught.labels)} labels")
        return taught


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
