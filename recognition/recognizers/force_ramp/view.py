"""View of the default recogniser: two discriminants, their temperature and a novelty detector.

One discriminant has the variation of grasps as they were taught, the other one that of sensors that
have drifted besides. Their log likelihoods are pooled with a weight that depends on when and
where a grasp was taken. Distances are measured in units of how far a grasp lies off in the
directions in which objects do not differ: on another day grasps lie off in all directions, a new
object mostly in those that separate objects.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from recognition.statistics.calibration import blocked_folds, fit_temperature, to_probability
from recognition.statistics.class_spread import ClassSpread, fit_class_spread
from recognition.statistics.fusion import fit_dependence
from recognition.statistics.lda import LinearDiscriminant, fit_lda, squared_distances
from recognition.statistics.novelty import NoveltyDetector, fit_novelty_detector, held_out_kept
from recognition.statistics.taught_sizes import TaughtSizes, fit_sizes

_FREEDOM = 3.0
"""Degrees of freedom of the t distribution of a grasp about its object: heavy tails."""
_BESIDE_POWER = 0.85
"""Power of the spread beside many classes by which distances are divided: objects left out of
teaching are found best between 0.75 and 1; the larger, the fewer grasps of another day are called
new."""
_PRIOR_AXES = 3.0
"""Axes between the classes at which half of that power is reached: few classes do not span what new
objects differ in, which then shows beside them."""
_NUISANCE_SD = (0.1, 1.0)
"""Standard deviations of the nuisance: of the logarithm of a gain, of the opening in mm. Twice as
much changes the answers little: the direction counts."""
_LEAST_DISTANCE = 0.1
"""Added to squared distances before their logarithm: nearer grasps are no less novel."""
_TOUCH_SHRINKAGE = 0.2
"""Least shrinkage of the covariance by touch alone."""
_OPENING_TARGET = 0.1
"""Variance of the opening's features, in that of touch, in the target of the shrinkage: hundreds of
features of touch repeat each other, which few grasps do not show, and as independent ones would
outweigh the opening. Chosen on the taught part of recorded objects, each among its nearest."""
_BLOCKS = 3
"""Blocks in time, held out in turn: few large ones, as grasps in use lie far in time."""
_LEFT_OUT_GROUPS = 6
"""Groups into which objects are dealt out; each in turn is left out, as an object never taught."""
_MIN_CLASSES_TO_LEAVE_OUT = 4
"""With fewer objects, too few would be left to teach: distance alone then decides on novelty."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassModel:
    """The classes under one covariance."""

    discriminant: LinearDiscriminant
    """The classes, its whitening kept."""
    spread: ClassSpread | None = None
    """The covariance of each class beside the shared one, by touch alone: there the variation of an
    object separates it from others. With the opening it would only fit the series that taught."""

    def score(
        self, features: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return scores (n, C) and the novelty (n,) of grasps with features (n, F).

        Scores are log likelihoods up to a constant of the grasp; the novelty is the logarithm of
        the squared distance to the nearest class.
        """
        z = self.discriminant.project(features)
        distances = squared_distances(z, self.discriminant.centres)
        unit = self._unit(features)
        novelty = np.log(distances.min(axis=1) / unit + _LEAST_DISTANCE)
        log_volume: NDArray[np.float64] | float = 0.0
        if self.spread is not None:
            distances, log_volume = self.spread.distances(z, distances), self.spread.log_volume
        rank = z.shape[1]
        tails = np.log1p(distances / unit[:, None] / rank)
        return -0.5 * (rank + _FREEDOM) * tails - log_volume, novelty

    def _unit(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (n,): the unit of squared distances, by the mean one beside the classes."""
        n_features, rank = self.discriminant.projection.shape
        if n_features == rank:
            return np.ones(len(features))
        beside = self.discriminant.beside(features) / (n_features - rank)
        power = _BESIDE_POWER * rank / (rank + _PRIOR_AXES)
        return np.asarray((1.0 + beside) ** power, dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One view: what it was taught, for grasps with the opening or by touch alone."""

    taught: ClassModel
    """The classes with the variation of the taught grasps."""
    drifted: ClassModel
    """The same with drift as a nuisance."""
    sizes: TaughtSizes
    """Sizes of the taught grasps; of no dimension where the opening is not used."""
    means: NDArray[np.float64]
    """(C, F) float64: mean features of each class."""
    slopes: NDArray[np.float64]
    """(d, F) float64: change of the features with the logarithm of the gain of each gripping pad
    and, where the view has the opening, with its zero in mm."""
    temperature: float
    """Log odds are divided by it."""
    usual_novelty: float
    """Median novelty of held-out grasps without their size: nearer ones are no less novel."""
    usual_size: float
    """What the size adds to the novelty at its limit: in place of a size that does not count."""
    novelty: NoveltyDetector
    """Detector of objects that were never taught."""
    dependence: float
    """How far grasps of one object repeat each other, 0 to 1."""

    def probabilities(
        self,
        features: NDArray[np.float64],
        sizes_mm: NDArray[np.float64],
        *,
        trust: float,
        caution: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return probabilities of the classes (n, C), and that the object is new (n,).

        ``trust`` from 0 to 1 is the weight of the classes without drift; with less than 1 the zero
        of the opening may have moved, and the sizes (n, k) do not count. ``caution`` is as in
        `NoveltyDetector.probability`.
        """
        scores, novelty = self.taught.score(features)
        size: float | NDArray[np.float64] = self.usual_size
        if trust == 1.0:
            size = self.sizes.novelty(sizes_mm, scores.argmax(axis=1))
        else:
            pooled = zip((scores, novelty), self.drifted.score(features), strict=True)
            scores, novelty = (trust * one + (1.0 - trust) * other for one, other in pooled)
        novelty = np.maximum(novelty, self.usual_novelty) + size
        new = self.novelty.probability(novelty, caution=caution)
        return to_probability(scores, self.temperature), new

    def drift_step(
        self, features: NDArray[np.float64], label: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the drift that grasps of one class show, (d,), and its covariance (d, d).

        Generalised least squares over the variation of the grasps; they share the object and how
        it lies, so that many count as little more than one.
        """
        taught = self.taught.discriminant
        assert taught.whitening is not None
        slopes = self.slopes / taught.scale @ taught.whitening
        off = (features - self.means[label]) / taught.scale @ taught.whitening
        spread = max(1.0, float(np.median((off**2).mean(axis=1))))
        scatter = np.asarray(np.linalg.inv(slopes @ slopes.T), dtype=np.float64)
        noise = spread * (1.0 + 1.0 / len(off))
        values: NDArray[np.float64] = scatter @ (slopes @ np.median(off, axis=0))
        return values, noise * scatter

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        spread = self.taught.spread
        return {
            **self.taught.discriminant.to_arrays(f"{prefix}taught_"),
            **self.drifted.discriminant.to_arrays(f"{prefix}drifted_"),
            **self.sizes.to_arrays(f"{prefix}sizes_"),
            f"{prefix}means": self.means,
            f"{prefix}slopes": self.slopes,
            f"{prefix}temperature": np.array(self.temperature),
            f"{prefix}usual_novelty": np.array(self.usual_novelty),
            f"{prefix}usual_size": np.array(self.usual_size),
            **({} if spread is None else spread.to_arrays(f"{prefix}spread_")),
            **self.novelty.to_arrays(f"{prefix}novelty_"),
            f"{prefix}dependence": np.array(self.dependence),
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(
            taught=ClassModel(
                discriminant=LinearDiscriminant.from_arrays(arrays, f"{prefix}taught_"),
                spread=ClassSpread.from_arrays(arrays, f"{prefix}spread_"),
            ),
            drifted=ClassModel(
                discriminant=LinearDiscriminant.from_arrays(arrays, f"{prefix}drifted_")
            ),
            sizes=TaughtSizes.from_arrays(arrays, f"{prefix}sizes_"),
            means=arrays[f"{prefix}means"],
            slopes=arrays[f"{prefix}slopes"],
            temperature=float(arrays[f"{prefix}temperature"]),
            usual_novelty=float(arrays[f"{prefix}usual_novelty"]),
            usual_size=float(arrays[f"{prefix}usual_size"]),
            novelty=NoveltyDetector.from_arrays(arrays, f"{prefix}novelty_"),
            dependence=float(arrays[f"{prefix}dependence"]),
        )


def fit_view(
    features: NDArray[np.float64],
    sizes_mm: NDArray[np.float64],
    classes: NDArray[np.int64],
    slopes: NDArray[np.float64],
    *,
    n_pads: int,
    n_opening: int = 0,
) -> View:
    """Teach a view.

    Parameters
    ----------
    features : (n, F)
        Finite features of the grasps; rows of one class in the order of time.
    sizes_mm : (n, k)
        Sizes of the grasps by the opening; with k = 0 the features have no opening either, and
        each class has a covariance of its own.
    classes : (n,)
        Class of each row, 0 to C - 1.
    slopes : (d, F)
        As `View.slopes`.
    n_pads
        Number of gripping pads, whose gains the first slopes are of.
    n_opening
        How many of the features, the last ones, are of the opening.

    Raises
    ------
    ValueError
        The rows do not show how grasps of a class vary.
    """
    n_classes, opening = int(classes.max()) + 1, sizes_mm.shape[1] > 0
    sd = np.array([_NUISANCE_SD[0]] * n_pads + [_NUISANCE_SD[1]])[: len(slopes)]
    target = np.ones(features.shape[1])
    target[len(target) - n_opening :] = _OPENING_TARGET
    nuisance = np.sqrt(len(slopes)) * sd[:, None] * slopes

    def teach(rows: NDArray[np.bool_], nuisance: NDArray[np.float64] | None = None) -> ClassModel:
        names, numbers = np.unique(classes[rows], return_inverse=True)
        discriminant = fit_lda(
            features[rows],
            numbers,
            len(names),
            min_shrinkage=0.0 if opening else _TOUCH_SHRINKAGE,
            target=target,
            nuisance=nuisance,
            keep_whitening=True,
        )
        spread = None
        if nuisance is None and not opening and len(names) > 1:
            projected = discriminant.project(features[rows])
            spread = fit_class_spread(projected, numbers, discriminant.centres)
        return ClassModel(discriminant=discriminant, spread=spread)

    def score(
        taught: NDArray[np.bool_], others: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        scores, novelty = teach(taught).score(features[others])
        sizes = fit_sizes(sizes_mm[taught], np.unique(classes[taught], return_inverse=True)[1])
        return scores, novelty, sizes.novelty(sizes_mm[others], scores.argmax(axis=1))

    every = np.ones(len(classes), dtype=np.bool_)
    blocks = blocked_folds(classes, _BLOCKS)
    parts = [score(~block, block) for block in blocks]
    rows = np.concatenate([np.flatnonzero(block) for block in blocks])
    scores, kept, kept_size = (np.concatenate(found) for found in zip(*parts, strict=True))
    usual = float(np.median(kept))
    kept = np.maximum(kept, usual)
    temperature = fit_temperature(scores, classes[rows])
    known, new = [np.zeros(0)], [np.zeros(0)]
    n_groups = min(_LEFT_OUT_GROUPS, n_classes) if n_classes >= _MIN_CLASSES_TO_LEAVE_OUT else 0
    for group in range(n_groups):
        out, block = classes % n_groups == group, blocks[group % len(blocks)]
        _, novelty, size = score(~out & ~block, block | out)
        novelty = np.maximum(novelty, usual) + size
        is_new = out[block | out]
        known.append(novelty[~is_new])
        new.append(novelty[is_new])
    share = held_out_kept(np.bincount(classes))
    even = float(np.quantile(kept + kept_size, share))
    block_of = np.repeat(np.arange(len(blocks)), [int(block.sum()) for block in blocks])
    order = np.argsort(rows)
    return View(
        taught=teach(every),
        drifted=teach(every, nuisance),
        sizes=fit_sizes(sizes_mm, classes),
        means=np.stack([features[classes == c].mean(axis=0) for c in range(n_classes)]),
        slopes=slopes,
        temperature=temperature,
        usual_novelty=usual,
        usual_size=even - float(np.quantile(kept, share)),
        novelty=fit_novelty_detector(np.concatenate(known), np.concatenate(new), even),
        dependence=fit_dependence(
            to_probability(scores, temperature)[order], classes[rows][order], block_of[order]
        ),
    )
