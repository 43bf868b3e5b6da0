"""Comparator and its trainer: features of a grasp, a plain classifier, calibration and novelty.

A comparator names objects by the method of its source. For the same tables as the others it also
returns probabilities (one temperature, fitted out of sample). The probability of an untaught object
compares the distance to the nearest taught grasp with that of held-out grasps.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from recognition.features.footprint import PadGrid, pad_grid, pressed
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
from recognition.recognizers.comparators.classifiers import Classifier
from recognition.statistics.array_record import without_prefix
from recognition.statistics.calibration import (
    KNOWN_KEPT,
    blocked_folds,
    fit_temperature,
    kept_temperature,
    to_probability,
)
from recognition.statistics.lda import squared_distances

PadFeatures = Callable[[NDArray[np.float64], PadGrid], NDArray[np.float64]]
"""From one pad's patch (n_taxels,) at full load, noise set to 0, and its grid to features (F,)."""

_FOLDS = 3
"""Blocks in time, each held out in turn to fit the temperature."""
_SHARPNESS = 4.0
"""Log odds of an untaught object for each unit of the logarithm of the squared distance."""
_PLAIN = ("labels", "uses_aperture", "fill", "mean", "scale", "temperature", "samples", "limit")
"""Fields that a model stores as arrays under their names."""
_PREFIX = "classifier_"
"""Prefix of the names of the classifier's arrays in a model."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Method:
    """Parts of one comparator."""

    name: str
    """Name in tables, models and on the command line."""
    features: PadFeatures | FeatureView
    """Its features, NaN if unknown: of each gripping pad alone, or a view of both along the ramp,
    which may include the opening."""
    classifier: type[Classifier]
    """Its classifier."""
    standardise: bool = True
    """Whether each feature is first centred and scaled to unit deviation."""

    def describe(self, levels: Levels, rest: Rest, use_aperture: bool) -> NDArray[np.float64]:
        """Return the features (n, F) of the levels of n grasps."""
        grids = [pad_grid(rest.pads, pad) for pad in rest.gripping]
        if isinstance(self.features, FeatureView):
            return features_of(levels, grids, self.features, opening=use_aperture)
        described = []
        for pad, (maps, grid) in enumerate(zip(levels.maps, grids, strict=True)):
            patches = pressed(maps[:, -1], levels.noise[:, -1, pad])
            described.append(np.stack([self.features(patch, grid) for patch in patches]))
        return np.concatenate(described, axis=1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Comparator:
    """A taught comparator; a subclass gives its `method`."""

    method: ClassVar[Method]

    labels: tuple[str, ...]
    """The taught objects, sorted."""
    uses_aperture: bool
    """Whether the opening between the fingers is used."""
    rest: Rest
    """The untouched pads."""
    fill: NDArray[np.float64]
    mean: NDArray[np.float64]
    scale: NDArray[np.float64]
    """(F,) float64: replacement of an unknown feature; centre and unit of each."""
    classifier: Classifier
    """The classifier."""
    temperature: float
    """Scores are divided by it."""
    samples: NDArray[np.float64]
    """(n, r) float64: taught grasps in the classifier's space."""
    limit: float
    """Squared distance to the nearest of them above which a grasp is more likely unknown."""

    @classmethod
    def trainer(cls, *, use_aperture: bool = True) -> "ComparatorTrainer":
        """Return a trainer of this comparator."""
        return ComparatorTrainer(kind=cls, use_aperture=use_aperture)

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp. Raises ValueError for pads other than the taught ones.

        A grasp that never touched both pads, or without finite features, gives even probabilities
        and is unknown with 1.
        """
        levels = load_levels([grasp], self.rest)
        features = self.method.describe(levels, self.rest, self.uses_aperture)
        features = np.where(np.isnan(features), self.fill, features)
        if not levels.touched[0] or not np.all(np.isfinite(features)):
            return Posterior.uninformed(self.labels)
        rows = (features - self.mean) / self.scale
        distance = max(
            squared_distances(self.classifier.space(rows), self.samples).min().item(), 1e-12
        )
        return Posterior(
            labels=self.labels,
            probability=to_probability(self.classifier.scores(rows), self.temperature)[0],
            unknown=float(expit(_SHARPNESS * np.log(distance / self.limit))),
        )

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the taught comparator as plain arrays."""
        return {
            "feature_version": np.array(FEATURE_VERSION),
            **{name: np.array(getattr(self, name)) for name in _PLAIN},
            **self.rest.to_arrays(),
            **{_PREFIX + name: array for name, array in self.classifier.to_arrays().items()},
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises ValueError that names a missing or wrong array."""
        learnt = without_prefix(arrays, _PREFIX)
        try:
            check_version(arrays)
            taught = cls(
                labels=tuple(str(label) for label in arrays["labels"]),
                uses_aperture=bool(arrays["uses_aperture"]),
                rest=Rest.from_arrays(arrays),
                fill=arrays["fill"],
                mean=arrays["mean"],
                scale=arrays["scale"],
                classifier=cls.method.classifier.from_arrays(learnt),
                temperature=kept_temperature(arrays["temperature"]),
                samples=arrays["samples"],
                limit=float(arrays["limit"]),
            )
        except KeyError as missing:
            raise ValueError(f"the model lacks the array {missing}") from missing
        try:
            row = np.zeros((1, len(taught.mean)))
            scores = taught.classifier.scores(row)
            squared_distances(taught.classifier.space(row), taught.samples)
        except (IndexError, ValueError, TypeError) as cause:
            raise ValueError(f"the arrays of the model do not fit each other: {cause}") from cause
        if scores.shape != (1, len(taught.labels)) or not np.all(np.isfinite(scores)):
            raise ValueError(
                f"the model scores {scores.shape[1]} objects and has {len(taught.labels)} labels"
            )
        return taught


@dataclass(frozen=True, slots=True, kw_only=True)
class ComparatorTrainer:
    """Teaches one comparator."""

    kind: type[Comparator]
    """Kind of the comparator."""
    use_aperture: bool = True
    """Whether the opening may be used; without effect if the method does not use it."""

    @property
    def name(self) -> str:
        """Name in tables, models and on the command line."""
        return self.kind.method.name

    @property
    def uses_aperture(self) -> bool:
        """Whether the opening between the fingers is used."""
        return self.use_aperture and isinstance(self.kind.method.features, FeatureView)

    def fit(self, grasps: Sequence[Grasp]) -> Comparator:
        """Teach with labelled grasps; those that never touched both pads are left out.

        Raises ValueError if they are too few, or scikit-learn is needed and missing.
        """
        method = self.kind.method
        ordered = [grasp for group in by_label(grasps).values() for grasp in group]
        rest = learn_rest(ordered)
        levels = load_levels(ordered, rest)
        features = method.describe(levels, rest, self.uses_aperture)
        kept = levels.touched
        labels, classes = np.unique(
            np.array([grasp.label for grasp in ordered])[kept], return_inverse=True
        )
        lost = {grasp.label for grasp in ordered} - set(labels.tolist())
        if len(labels) < 2 or lost:
            raise ValueError(
                f"{method.name}: {len(labels)} objects with a grasp that touched both pads; "
                f"missing: {sorted(lost)}: teach at least two objects, and press harder"
            )
        features = features[kept]
        known = np.isfinite(features)
        fill = np.where(known, features, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        features = np.where(known, features, fill)
        mean, scale = np.zeros_like(fill), np.ones_like(fill)
        if method.standardise:
            mean, spread = features.mean(axis=0), features.std(axis=0)
            scale = np.where(spread > 1e-9, spread, 1.0)
        rows = (features - mean) / scale
        classifier = method.classifier.fit(rows, classes, len(labels))
        folds = blocked_folds(classes, _FOLDS)
        if not folds:
            raise ValueError(f"{method.name}: teach each object at least twice")
        scores, distances = [], []
        for held in folds:
            taught = method.classifier.fit(rows[~held], classes[~held], len(labels))
            apart = squared_distances(taught.space(rows[held]), taught.space(rows[~held]))
            scores.append(taught.scores(rows[held]))
            distances.append(apart.min(axis=1))
        held_classes = np.concatenate([classes[held] for held in folds])
        return self.kind(
            labels=tuple(labels.tolist()),
            uses_aperture=self.uses_aperture,
            rest=rest,
            fill=fill,
            mean=mean,
            scale=scale,
            classifier=classifier,
            temperature=fit_temperature(np.concatenate(scores), held_classes),
            samples=classifier.space(rows),
            limit=max(float(np.quantile(np.concatenate(distances), KNOWN_KEPT)), 1e-9),
        )
