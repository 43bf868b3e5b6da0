"""One way to look at a grasp: a discriminant, its temperature and its sense of the strange."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.calibration import blocked_folds, fit_temperature, out_of_sample, to_probability
from recognition.dependence import fit_dependence
from recognition.lda import LinearDiscriminant, fit_lda
from recognition.novelty import Novelty, fit_novelty, novelty_signs

_FOLDS = 6
_BLOCKS = 3
"""Dependence shows between grasps that lie far from all taught ones: few and large blocks."""
_LEFT_OUT_GROUPS = 6
_MIN_CLASSES_TO_LEAVE_OUT = 4


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """A taught view.

    Attributes
    ----------
    discriminant
        The classes.
    second
        Another discriminant that gives a second opinion on strangeness, on features that are the
        first ones of the view's; None for none.
    samples : (n, r) float64
        The taught grasps in the discriminant space.
    temperature
        Log odds are divided by it.
    novelty
        What is strange.
    dependence
        How far grasps of one object repeat each other.
    """

    discriminant: LinearDiscriminant
    second: LinearDiscriminant | None
    samples: NDArray[np.float64]
    temperature: float
    novelty: Novelty
    dependence: float

    def probability(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n, C) calibrated probabilities for features (n, F)."""
        return to_probability(-0.5 * self.discriminant.distances(features), self.temperature)

    def unknown(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n,) probabilities that the object was never taught."""
        return self.novelty.probability(
            _signs(self.discriminant, self.second, self.samples, features)
        )

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        arrays = {
            f"{prefix}samples": self.samples,
            f"{prefix}temperature": np.array(self.temperature),
            f"{prefix}dependence": np.array(self.dependence),
            f"{prefix}has_second": np.array(self.second is not None),
            **self.discriminant.to_arrays(f"{prefix}lda_"),
            **self.novelty.to_arrays(f"{prefix}novelty_"),
        }
        if self.second is not None:
            arrays |= self.second.to_arrays(f"{prefix}second_")
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        second = None
        if bool(arrays[f"{prefix}has_second"]):
            second = LinearDiscriminant.from_arrays(arrays, f"{prefix}second_")
        return cls(
            discriminant=LinearDiscriminant.from_arrays(arrays, f"{prefix}lda_"),
            second=second,
            samples=arrays[f"{prefix}samples"],
            temperature=float(arrays[f"{prefix}temperature"]),
            novelty=Novelty.from_arrays(arrays, f"{prefix}novelty_"),
            dependence=float(arrays[f"{prefix}dependence"]),
        )


def fit_view(
    features: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
    *,
    n_second: int | None = None,
) -> View:
    """Teach a view.

    Parameters
    ----------
    features : (n, F)
        Finite features; rows of one class in the order of time.
    classes : (n,)
        Class of each row.
    n_classes
        Number of classes.
    n_second
        How many of the first features the second opinion goes by; None for no second opinion.

    Raises
    ------
    ValueError
        The rows do not show how grasps of one class vary.
    """
    discriminant, second = _pair(features, classes, n_classes, n_second)
    folds = blocked_folds(classes, _FOLDS)
    signs = np.full((len(classes), 3 if n_second is None else 5), np.nan)

    def score(fit: NDArray[np.bool_], test: NDArray[np.bool_]) -> NDArray[np.float64]:
        lda, other = _pair(features[fit], classes[fit], n_classes, n_second)
        signs[test] = _signs(lda, other, lda.project(features[fit]), features[test])
        return lda.distances(features[test])

    distances, scored = out_of_sample(score, folds, n_classes)
    known, left_out = _leave_out(features, classes, n_classes, n_second, folds)
    temperature = fit_temperature(-0.5 * distances[scored], classes[scored])
    return View(
        discriminant=discriminant,
        second=second,
        samples=discriminant.project(features),
        temperature=temperature,
        novelty=fit_novelty(known, left_out, signs[scored]),
        dependence=_dependence(features, classes, n_classes, temperature),
    )


def _dependence(
    features: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
    temperature: float,
) -> float:
    """Return how far grasps repeat each other, from large blocks that were held out in turn."""
    blocks = blocked_folds(classes, _BLOCKS)

    def score(fit: NDArray[np.bool_], test: NDArray[np.bool_]) -> NDArray[np.float64]:
        return fit_lda(features[fit], classes[fit], n_classes).distances(features[test])

    distances, scored = out_of_sample(score, blocks, n_classes)
    return fit_dependence(
        to_probability(-0.5 * distances[scored], temperature),
        classes[scored],
        np.argmax(np.stack(blocks), axis=0)[scored],
    )


def _pair(
    features: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
    n_second: int | None,
) -> tuple[LinearDiscriminant, LinearDiscriminant | None]:
    first = fit_lda(features, classes, n_classes)
    if n_second is None:
        return first, None
    return first, fit_lda(features[:, :n_second], classes, n_classes)


def _leave_out(
    features: NDArray[np.float64],
    classes: NDArray[np.int64],
    n_classes: int,
    n_second: int | None,
    folds: list[NDArray[np.bool_]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return signs of held-out grasps of taught classes, and of grasps of left-out classes."""
    n_signs = 3 if n_second is None else 5
    known, left_out = [np.zeros((0, n_signs))], [np.zeros((0, n_signs))]
    n_groups = min(_LEFT_OUT_GROUPS, n_classes) if n_classes >= _MIN_CLASSES_TO_LEAVE_OUT else 0
    for group in range(n_groups):
        out = classes % n_groups == group
        held_out = folds[group % len(folds)]
        fit = ~out & ~held_out
        remaining, renumbered = np.unique(classes[fit], return_inverse=True)
        lda, other = _pair(features[fit], renumbered, len(remaining), n_second)
        samples = lda.project(features[fit])
        known.append(_signs(lda, other, samples, features[~out & held_out]))
        left_out.append(_signs(lda, other, samples, features[out]))
    return np.concatenate(known), np.concatenate(left_out)


def _signs(
    lda: LinearDiscriminant,
    second: LinearDiscriminant | None,
    samples: NDArray[np.float64],
    features: NDArray[np.float64],
) -> NDArray[np.float64]:
    z = lda.project(features)
    squared = ((z**2).sum(axis=1)[:, None] + (samples**2).sum(axis=1)) - 2.0 * z @ samples.T
    opinion = None if second is None else second.distances(features[:, : len(second.mean)])
    return novelty_signs(lda.distances(features), np.maximum(squared, 0.0).min(axis=1), opinion)
