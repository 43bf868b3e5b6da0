"""One way to look at a grasp: its classes, their temperature and the sense of the strange."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.calibration import blocked_folds, fit_temperature, to_probability
from recognition.dependence import fit_dependence
from recognition.drift import DriftGrid
from recognition.drift_sense import DriftSense, fit_drift_sense
from recognition.novelty import Novelty, fit_novelty
from recognition.recognizers._evidence import Evidence
from recognition.recognizers._evidence_fit import fit_evidence
from recognition.recognizers._telling import Rows

_BLOCKS = 3
"""Grasps in use lie far in time from all taught ones, so few and large blocks are held out."""
_LEFT_OUT_GROUPS = 6
_MIN_CLASSES_TO_LEAVE_OUT = 4
_DRIFT_GRASPS = 500
"""About as many held-out grasps suffice to say what drifts grasps without one seem to have."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A taught view.

    Attributes
    ----------
    evidence
        The classes.
    temperature
        Log odds are divided by it.
    novelty
        What is strange.
    dependence
        How far grasps of one object repeat each other.
    drift_sense
        What shows a drift; None where a single object was taught.
    drift_bias : (G, O) float64
        Mean log likelihood of each drift in grasps without one that were held out of teaching.
    """

    evidence: Evidence
    temperature: float
    novelty: Novelty
    dependence: float
    drift_sense: DriftSense | None
    drift_bias: NDArray[np.float64]

    def answer(
        self, rows: Rows, grid: DriftGrid
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return calibrated probabilities (n, C), and (n,) that the object was never taught."""
        told = self.evidence.tell(rows, grid.log_prior)
        return (
            to_probability(told.scores, self.temperature),
            self.novelty.probability(told.signs),
        )

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        arrays = {
            f"{prefix}temperature": np.array(self.temperature),
            f"{prefix}dependence": np.array(self.dependence),
            f"{prefix}drift_bias": self.drift_bias,
            f"{prefix}senses_drift": np.array(self.drift_sense is not None),
            **self.evidence.to_arrays(prefix),
            **self.novelty.to_arrays(f"{prefix}novelty_"),
        }
        if self.drift_sense is not None:
            arrays |= self.drift_sense.to_arrays(f"{prefix}drift_")
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        sense = None
        if bool(arrays[f"{prefix}senses_drift"]):
            sense = DriftSense.from_arrays(arrays, f"{prefix}drift_")
        return cls(
            drift_sense=sense,
            drift_bias=arrays[f"{prefix}drift_bias"],
            evidence=Evidence.from_arrays(arrays, prefix),
            temperature=float(arrays[f"{prefix}temperature"]),
            novelty=Novelty.from_arrays(arrays, f"{prefix}novelty_"),
            dependence=float(arrays[f"{prefix}dependence"]),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Lesson:
    """What a view is taught with.

    Attributes
    ----------
    features : (n, F) float64
        Finite features as they were recorded; rows of one class in the order of time.
    virtual : (n, F) float64 or None
        Features of a virtual grasp for each row.
    nuisance : (k, n, F) float64 or None
        How the features of each row deviate in k placings that differ a little.
    rows
        The same grasps under each drift of the grid.
    classes : (n,) int64
        Class of each row.
    n_classes
        Number of classes.
    n_second
        How many of the first features the second opinion goes by; None for no second opinion.
    grid
        What the drift may be.
    """

    features: NDArray[np.float64]
    virtual: NDArray[np.float64] | None
    nuisance: NDArray[np.float64] | None
    rows: Rows
    classes: NDArray[np.int64]
    n_classes: int
    n_second: int | None
    grid: DriftGrid

    def fit(self, taught: NDArray[np.bool_] | None = None) -> Evidence:
        """Teach with some of the rows; classes without any are left out, the rest renumbered."""
        mask = np.ones(len(self.classes), dtype=np.bool_) if taught is None else taught
        remaining, renumbered = np.unique(self.classes[mask], return_inverse=True)
        return fit_evidence(
            self.features[mask],
            renumbered,
            len(remaining),
            virtual=None if self.virtual is None else self.virtual[mask],
            nuisance=(
                None
                if self.nuisance is None
                else self.nuisance[:, mask].reshape(-1, self.features.shape[1])
            ),
            n_second=self.n_second,
        )


def fit_view(lesson: Lesson) -> View:
    """Teach a view. Raises ValueError where the rows do not show how grasps of a class vary."""
    classes, prior = lesson.classes, lesson.grid.log_prior
    blocks = blocked_folds(classes, _BLOCKS)
    fits = [lesson.fit(~held_out) for held_out in blocks]
    reach = _reach(lesson, blocks, fits)
    evidence = replace(lesson.fit(), reach=reach)
    signs = np.full((len(classes), evidence.n_signs), np.nan)
    scores = np.full((len(classes), lesson.n_classes), np.nan)
    drifts: list[NDArray[np.float64]] = []
    every = -(-len(classes) // _DRIFT_GRASPS)
    for held_out, fit in zip(blocks, fits, strict=True):
        rows = lesson.rows.take(held_out)
        few = np.arange(len(rows.tactile)) % every == 0
        drifts.append(fit.under_drifts(rows.take(few)))
        told = replace(fit, reach=reach).tell(rows, prior)
        scores[held_out], signs[held_out] = told.scores, told.signs
    scored = np.any(blocks, axis=0)
    scores, signs, classes = scores[scored], signs[scored], classes[scored]
    known, left_out = _leave_out(lesson, blocks, evidence.n_signs)
    temperature = fit_temperature(scores, classes)
    return View(
        evidence=evidence,
        temperature=temperature,
        novelty=fit_novelty(known, left_out, signs),
        dependence=fit_dependence(
            to_probability(scores, temperature),
            classes,
            np.argmax(np.stack(blocks), axis=0)[scored],
        ),
        drift_sense=_drift_sense(lesson),
        drift_bias=np.concatenate(drifts).mean(axis=0),
    )


def _reach(lesson: Lesson, blocks: Sequence[NDArray[np.bool_]], fits: Sequence[Evidence]) -> float:
    """Return how far out the middle one of the held-out grasps lies, at least 1.

    By touch alone it is 1: a gain alone hardly turns one object into another.
    """
    if len(lesson.grid.offsets_mm) == 1:
        return 1.0
    found = [
        fit.spread_of(lesson.features[held_out], lesson.classes[held_out])
        for held_out, fit in zip(blocks, fits, strict=True)
    ]
    return max(1.0, float(np.median(np.concatenate(found))))


def _drift_sense(lesson: Lesson) -> DriftSense | None:
    """Teach what shows a drift, by gains and offsets half way to the end of the grid."""
    rows, (n_gains, n_offsets) = lesson.rows, lesson.grid.log_prior.shape
    gain, offset = n_gains // 2, n_offsets // 2
    pairs = [(gain + step, offset) for step in (-(gain // 2), gain // 2) if step]
    pairs += [(gain, offset + step) for step in (-(offset // 2), offset // 2) if step]
    if not pairs:
        return None
    drifted = [np.concatenate([rows.tactile[:, g], rows.aperture[:, o]], axis=1) for g, o in pairs]
    return fit_drift_sense(lesson.features, np.stack(drifted), lesson.classes, lesson.n_classes)


def _leave_out(
    lesson: Lesson, blocks: Sequence[NDArray[np.bool_]], n_signs: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return signs of held-out grasps of taught classes, and of grasps of left-out classes."""
    known, left_out = [np.zeros((0, n_signs))], [np.zeros((0, n_signs))]
    n_groups = (
        min(_LEFT_OUT_GROUPS, lesson.n_classes)
        if lesson.n_classes >= _MIN_CLASSES_TO_LEAVE_OUT
        else 0
    )
    for group in range(n_groups):
        out = lesson.classes % n_groups == group
        held_out = blocks[group % len(blocks)]
        evidence = lesson.fit(~out & ~held_out)
        for mask, signs in ((~out & held_out, known), (out, left_out)):
            if np.any(mask):
                signs.append(evidence.signs(lesson.rows.take(mask), lesson.grid.log_prior))
    return np.concatenate(known), np.concatenate(left_out)
