"""Plain reference `shrinkage_lda`: one linear discriminant, one temperature, one distance."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from recognition.features.footprint import pad_grid
from recognition.features.groups import (
    FEATURE_VERSION,
    FeatureView,
    check_version,
    features_of,
)
from recognition.grasp import Grasp, by_label
from recognition.ramp.levels import Levels, load_levels
from recognition.ramp.ramp import Rest, learn_rest
from recognition.recognizer import Posterior
from recognition.statistics.calibration import (
    KNOWN_KEPT,
    blocked_folds,
    fit_temperature,
    out_of_sample,
    to_probability,
)
from recognition.statistics.lda import LinearDiscriminant, fit_lda

_FOLDS = 4
"""Blocks in time, each held out in turn to fit the temperature."""
_SHARPNESS = 4.0
"""Log odds of an untaught object for each unit of the logarithm of the squared distance."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShrinkageLda:
    """A taught linear discriminant."""

    labels: tuple[str, ...]
    """The taught objects, sorted."""
    uses_aperture: bool
    """Whether the opening between the fingers is used."""
    rest: Rest
    """The untouched pads."""
    fill: NDArray[np.float64]
    """(F,) float64: value in place of a feature that is unknown."""
    discriminant: LinearDiscriminant
    """The classes."""
    temperature: float
    """Squared distances are divided by it."""
    limit: float
    """Squared distance to the nearest class above which a grasp is more likely unknown."""

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp; ValueError for pads other than the taught ones."""
        levels = load_levels([grasp], self.rest)
        features = _features(levels, self.rest, self.uses_aperture)
        distances = self.discriminant.distances(np.where(np.isnan(features), self.fill, features))
        unknown = float(expit(_SHARPNESS * np.log(max(distances.min(), 1e-9) / self.limit)))
        return Posterior(
            labels=self.labels,
            probability=to_probability(-0.5 * distances, self.temperature)[0],
            unknown=unknown if levels.touched[0] else 1.0,
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all that was learnt as plain arrays."""
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
        """Rebuild from `to_arrays`. Raises ValueError, naming what is missing or does not fit."""
        try:
            check_version(arrays)
            return cls(
                labels=tuple(str(label) for label in arrays["labels"]),
                uses_aperture=bool(arrays["uses_aperture"]),
                rest=Rest.from_arrays(arrays),
                fill=arrays["fill"],
                discriminant=LinearDiscriminant.from_arrays(arrays, "lda_"),
                temperature=float(arrays["temperature"]),
                limit=float(arrays["limit"]),
            )
        except KeyError as missing:
            raise ValueError(f"the model lacks the array {missing}") from missing


@dataclass(frozen=True, slots=True, kw_only=True)
class ShrinkageLdaTrainer:
    """Teaches the plain linear discriminant."""

    name: ClassVar[str] = "shrinkage_lda"
    use_aperture: bool = True

    @property
    def uses_aperture(self) -> bool:
        """Whether the opening between the fingers is used."""
        return self.use_aperture

    def fit(self, grasps: Sequence[Grasp]) -> ShrinkageLda:
        """Teach with labelled grasps. Raises ValueError where they do not suffice."""
        members = by_label(grasps)
        labels = tuple(members)
        if len(labels) < 2:
            raise ValueError(
                f"{len(labels)} object taught, which separates nothing: teach at least two"
            )
        ordered = [g for group in members.values() for g in group]
        classes = np.repeat(np.arange(len(labels)), [len(m) for m in members.values()])
        rest = learn_rest(ordered)
        features = _features(load_levels(ordered, rest), rest, self.use_aperture)
        known = np.isfinite(features)
        fill = np.where(known, features, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        features = np.where(known, features, fill)

        def score(fit: NDArray[np.bool_], test: NDArray[np.bool_]) -> NDArray[np.float64]:
            lda = fit_lda(features[fit], classes[fit], len(labels))
            return lda.distances(features[test])

        discriminant = fit_lda(features, classes, len(labels))
        folds = blocked_folds(classes, _FOLDS)
        distances, scored = out_of_sample(score, folds, len(labels))
        distances = distances[scored]
        return ShrinkageLda(
            labels=labels,
            uses_aperture=self.use_aperture,
            rest=rest,
            fill=fill,
            discriminant=discriminant,
            temperature=fit_temperature(-0.5 * distances, classes[scored]),
            limit=float(np.quantile(distances.min(axis=1), KNOWN_KEPT)),
        )


def _features(levels: Levels, rest: Rest, use_aperture: bool) -> NDArray[np.float64]:
    grids = [pad_grid(rest.pads, pad) for pad in rest.gripping]
    return features_of(levels, grids, FeatureView.SHRINKAGE_LDA, opening=use_aperture)
