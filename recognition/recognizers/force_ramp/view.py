"""View of the default recogniser: class likelihoods, their temperature and a novelty detector."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.drift.discriminant import DriftDiscriminant, fit_drift_discriminant
from recognition.drift.drift import DriftGrid
from recognition.recognizers.force_ramp.likelihood import (
    ClassLikelihood,
    ClassScores,
    fit_class_likelihood,
)
from recognition.recognizers.force_ramp.training_set import FeatureRows, TrainingSet
from recognition.statistics.calibration import blocked_folds, fit_temperature, to_probability
from recognition.statistics.fusion import fit_dependence
from recognition.statistics.novelty import NoveltyDetector, fit_novelty_detector

_BLOCKS = 3
"""Blocks held out in turn: grasps in use lie far in time from all taught ones, so few large
ones."""
_LEFT_OUT_GROUPS = 6
"""Groups into which objects are dealt out; each in turn is left out, as an object never taught."""
_MIN_CLASSES_TO_LEAVE_OUT = 4
"""With fewer objects, too few would be left to teach: distance alone then decides on novelty."""
_DRIFT_GRASPS = 500
"""About as many held-out grasps suffice for the mean log likelihood of drifts without a drift."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One view: what it was taught, for grasps with the opening or by touch alone.

    Attributes
    ----------
    likelihood
        The classes.
    temperature
        Log odds are divided by it.
    novelty
        Detector of objects that were never taught.
    dependence
        How far grasps of one object repeat each other, 0 to 1.
    drift_discriminant
        Discriminant of drifts; None where a single object was taught.
    drift_bias : (G, O) float64
        Mean log likelihood of each drift in grasps without one that were held out of teaching.
    """

    likelihood: ClassLikelihood
    temperature: float
    novelty: NoveltyDetector
    dependence: float
    drift_discriminant: DriftDiscriminant | None
    drift_bias: NDArray[np.float64]

    def probabilities(
        self, rows: FeatureRows, grid: DriftGrid
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return calibrated probabilities (n, C), and (n,) that the object was never taught."""
        found = self.likelihood.score(rows, grid.log_prior)
        return (
            to_probability(found.scores, self.temperature),
            self.novelty.probability(found.novelty),
        )

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        arrays = {
            f"{prefix}temperature": np.array(self.temperature),
            f"{prefix}dependence": np.array(self.dependence),
            f"{prefix}drift_bias": self.drift_bias,
            f"{prefix}senses_drift": np.array(self.drift_discriminant is not None),
            **self.likelihood.to_arrays(prefix),
            **self.novelty.to_arrays(f"{prefix}novelty_"),
        }
        if self.drift_discriminant is not None:
            arrays |= self.drift_discriminant.to_arrays(f"{prefix}drift_")
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        discriminant = None
        if bool(arrays[f"{prefix}senses_drift"]):
            discriminant = DriftDiscriminant.from_arrays(arrays, f"{prefix}drift_")
        return cls(
            drift_discriminant=discriminant,
            drift_bias=arrays[f"{prefix}drift_bias"],
            likelihood=ClassLikelihood.from_arrays(arrays, prefix),
            temperature=float(arrays[f"{prefix}temperature"]),
            novelty=NoveltyDetector.from_arrays(arrays, f"{prefix}novelty_"),
            dependence=float(arrays[f"{prefix}dependence"]),
        )


def fit_view(training: TrainingSet) -> View:
    """Teach a view. Raises ValueError where the rows do not show how grasps of a class vary."""
    blocks = blocked_folds(training.classes, _BLOCKS)
    fits = [fit_class_likelihood(training, ~held_out) for held_out in blocks]
    reach = _reach(training, blocks, fits)
    likelihood = replace(fit_class_likelihood(training), reach=reach)
    found = _held_out_scores(training, blocks, [replace(fit, reach=reach) for fit in fits])
    scored = np.any(blocks, axis=0)
    scores, classes = found.scores[scored], training.classes[scored]
    known, left_out = _leave_out(training, blocks, likelihood.n_novelty_features)
    temperature = fit_temperature(scores, classes)
    return View(
        likelihood=likelihood,
        temperature=temperature,
        novelty=fit_novelty_detector(known, left_out, found.novelty[scored]),
        dependence=fit_dependence(
            to_probability(scores, temperature),
            classes,
            np.argmax(np.stack(blocks), axis=0)[scored],
        ),
        drift_discriminant=_drift_discriminant(training),
        drift_bias=_drift_bias(training, blocks, fits),
    )


def _held_out_scores(
    training: TrainingSet, blocks: Sequence[NDArray[np.bool_]], fits: Sequence[ClassLikelihood]
) -> ClassScores:
    """Return scores of each grasp by the fit without its block; NaN for grasps in no block."""
    n = len(training.classes)
    novelty = np.full((n, fits[0].n_novelty_features), np.nan)
    scores = np.full((n, training.n_classes), np.nan)
    for held_out, fit in zip(blocks, fits, strict=True):
        found = fit.score(training.rows.take(held_out), training.grid.log_prior)
        scores[held_out], novelty[held_out] = found.scores, found.novelty
    return ClassScores(scores=scores, novelty=novelty)


def _drift_bias(
    training: TrainingSet, blocks: Sequence[NDArray[np.bool_]], fits: Sequence[ClassLikelihood]
) -> NDArray[np.float64]:
    """Return the mean log likelihood (G, O) of drifts in held-out grasps, which have none."""
    every = -(-len(training.classes) // _DRIFT_GRASPS)
    drifts = []
    for held_out, fit in zip(blocks, fits, strict=True):
        rows = training.rows.take(held_out)
        few = np.arange(len(rows.tactile)) % every == 0
        drifts.append(fit.drift_log_likelihood(rows.take(few)))
    return np.asarray(np.concatenate(drifts).mean(axis=0), dtype=np.float64)


def _reach(
    training: TrainingSet, blocks: Sequence[NDArray[np.bool_]], fits: Sequence[ClassLikelihood]
) -> float:
    """Return the median squared distance per axis of held-out grasps to their centres, at least 1.

    By touch alone it is 1: a gain alone hardly turns one object into another.
    """
    if len(training.grid.offsets_mm) == 1:
        return 1.0
    found = [
        fit.spread_of(training.features[held_out], training.classes[held_out])
        for held_out, fit in zip(blocks, fits, strict=True)
    ]
    return max(1.0, float(np.median(np.concatenate(found))))


def _drift_discriminant(training: TrainingSet) -> DriftDiscriminant | None:
    """Return a discriminant of drifts, from gains and offsets half way to the end of the grid."""
    rows, (n_gains, n_offsets) = training.rows, training.grid.log_prior.shape
    gain, offset = n_gains // 2, n_offsets // 2
    pairs = [(gain + step, offset) for step in (-(gain // 2), gain // 2) if step]
    pairs += [(gain, offset + step) for step in (-(offset // 2), offset // 2) if step]
    if not pairs:
        return None
    drifted = [np.concatenate([rows.tactile[:, g], rows.aperture[:, o]], axis=1) for g, o in pairs]
    return fit_drift_discriminant(
        training.features, np.stack(drifted), training.classes, training.n_classes
    )


def _leave_out(
    training: TrainingSet, blocks: Sequence[NDArray[np.bool_]], n_features: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return novelty features of held-out grasps of taught classes, and of left-out classes."""
    known, left_out = [np.zeros((0, n_features))], [np.zeros((0, n_features))]
    n_groups = (
        min(_LEFT_OUT_GROUPS, training.n_classes)
        if training.n_classes >= _MIN_CLASSES_TO_LEAVE_OUT
        else 0
    )
    for group in range(n_groups):
        out = training.classes % n_groups == group
        held_out = blocks[group % len(blocks)]
        fit = fit_class_likelihood(training, ~out & ~held_out)
        for mask, features in ((~out & held_out, known), (out, left_out)):
            if np.any(mask):
                features.append(fit.novelty(training.rows.take(mask), training.grid.log_prior))
    return np.concatenate(known), np.concatenate(left_out)
