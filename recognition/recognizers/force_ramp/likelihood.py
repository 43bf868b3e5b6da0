"""Class likelihoods of a view: log likelihood of each class, summed over possible drifts.

The likelihood of a class has heavy tails (multivariate t): grasps of another minute lie further
out than those that taught, and under a normal density a large drift would then be likelier than
such a grasp. It is the geometric mean of two: around the centre of the class, with a covariance of
its own, and around its taught grasps. Constants without another source were chosen on the grasps
that teach, of 36 recorded objects (docs/explanations/recogniser.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.recognizers.force_ramp.class_spread import ClassSpread, fit_spread
from recognition.recognizers.force_ramp.training_set import FeatureRows, TrainingSet
from recognition.statistics.lda import LinearDiscriminant, fit_lda, squared_distances
from recognition.statistics.novelty import novelty_features


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassScores:
    """Class scores and novelty features of n grasps.

    Attributes
    ----------
    scores : (n, C) float64
        Logarithm of the likelihood of each class, up to a constant of the grasp.
    novelty : (n, S) float64
        Novelty features, taken under the expected drift: a drift could explain too much of what a
        new object changes.
    """

    scores: NDArray[np.float64]
    novelty: NDArray[np.float64]


_FREEDOM = 3.0
"""Degrees of freedom of the multivariate t: fewer give heavier tails."""
_MAX_HYPOTHESES = 24
"""Drifts under which the taught grasps are compared: the likeliest ones; others hardly count."""
_PARTS = 4
"""Parts of a product of small matrices: whole, a library shares it among threads, which is
slower."""
_DRIFT_ROOT = 2.0
"""Root of the likelihood of a drift: features are not as independent as the likelihood takes
them."""
_ROWS_AT_ONCE = 256
"""Grasps at a time for novelty features alone: their arrays stay in the processor's cache."""
_LEAST_SHARE = 1e-30
"""Added to sums of relative densities before the logarithm: those of far classes underflow to 0."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassLikelihood:
    """Taught classes of a view, in its discriminant space.

    Attributes
    ----------
    discriminant
        The classes, by the features of touch and then those of the opening.
    second
        Another discriminant, of the first features of touch: its distances are novelty features,
        and show drifts where the opening is not used; None for none.
    samples : (m, r) float64
        The taught grasps in the discriminant space, and virtual ones, sorted by class.
    sample_class : (m,) int64
        Their classes.
    log_weight : (m,) float64
        Logarithm of how much each of them counts; those of a class sum to 1.
    spread
        How the grasps of each class vary in that space.
    reach
        Squared distances are divided by it: grasps of another time lie further out than those that
        taught, and the fewer taught the further. Without it a drift would explain them better.
    """

    discriminant: LinearDiscriminant
    second: LinearDiscriminant | None
    samples: NDArray[np.float64]
    sample_class: NDArray[np.int64]
    log_weight: NDArray[np.float64]
    spread: ClassSpread
    reach: float = 1.0

    @property
    def n_novelty_features(self) -> int:
        """Number of novelty features."""
        return 5 if self.second is None else 7

    def score(self, rows: FeatureRows, log_prior: NDArray[np.float64]) -> ClassScores:
        """Return scores and novelty features of grasps, with log prior (G, O) of the drifts."""
        found = [
            self._score_one(tactile, aperture, log_prior.ravel())
            for tactile, aperture in zip(rows.tactile, rows.aperture, strict=True)
        ]
        return ClassScores(
            scores=np.array([scores for scores, _ in found]),
            novelty=np.array([novelty for _, novelty in found]),
        )

    def novelty(self, rows: FeatureRows, log_prior: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the novelty features (n, S) of `score` alone, which takes far less time."""
        gain, offset = np.unravel_index(int(np.argmax(log_prior)), log_prior.shape)
        found = [np.zeros((0, self.n_novelty_features))]
        for start in range(0, len(rows.tactile), _ROWS_AT_ONCE):
            part = slice(start, start + _ROWS_AT_ONCE)
            tactile, aperture = rows.tactile[part, gain], rows.aperture[part, offset]
            touch, opening = self._project(tactile, aperture)
            z = touch + opening
            distance = squared_distances(z, self.discriminant.centres)
            own = self.spread.distances(z, distance)
            nearest = squared_distances(z, self.samples).min(axis=1)
            found.append(self._novelty(distance, own, nearest, tactile, aperture))
        return np.concatenate(found)

    def spread_of(
        self, features: NDArray[np.float64], classes: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return (n,): mean squared distance per axis of labelled grasps to their centres.

        The expected value of grasps like the taught ones is 1.
        """
        off = self.discriminant.project(features) - self.discriminant.centres[classes]
        return np.asarray((off**2).mean(axis=1), dtype=np.float64)

    def drift_log_likelihood(self, rows: FeatureRows) -> NDArray[np.float64]:
        """Return (n, G, O): log likelihood of each drift, whatever was held, up to a constant."""
        shape = rows.tactile.shape[1], rows.aperture.shape[1]
        found = []
        for tactile, aperture in zip(rows.tactile, rows.aperture, strict=True):
            distance, rank = self._drift_distances(tactile, aperture)
            scores = -0.5 * (rank + _FREEDOM) * np.log1p(distance / rank)
            found.append(logsumexp(scores / _DRIFT_ROOT, axis=1).reshape(shape))
        return np.array(found)

    def _drift_distances(
        self, tactile: NDArray[np.float64], aperture: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], float]:
        """Return (G * O, C) squared distances that show a drift, and in how many dimensions."""
        if self.second is None or aperture.shape[1]:
            return self._distances(*self._project(tactile, aperture)), self._rank
        # Without the opening, features that no gain changes would hide a gain.
        distance = self.second.distances(tactile[:, : len(self.second.mean)])
        rank = float(self.second.projection.shape[1])
        return np.repeat(distance, len(aperture), axis=0), rank

    def _score_one(
        self,
        tactile: NDArray[np.float64],
        aperture: NDArray[np.float64],
        log_prior: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return scores (C,) and novelty features (S,) of one grasp."""
        touch, opening = self._project(tactile, aperture)
        from_touch, from_opening, both = self._distance_parts(touch, opening)
        expected = int(np.argmax(log_prior))
        drifts = self._likely_drifts(from_touch, from_opening, both, log_prior, expected)
        gain, offset = np.divmod(drifts, len(aperture))
        distance = from_touch[gain] + from_opening[offset] + both[gain, offset, None]
        distance = np.maximum(distance, 0.0, out=distance)
        z = touch[gain] + opening[offset]
        squared = self._to_samples(z)
        own = self.spread.distances(z, distance)
        together = log_prior[drifts, None] + 0.5 * (self._around(own) + self._near(squared))
        gains, offsets = np.divmod([expected], len(aperture))
        nearest = squared[-1:].min(axis=1)
        novelty = self._novelty(distance[-1:], own[-1:], nearest, tactile[gains], aperture[offsets])
        return np.asarray(logsumexp(together, axis=0), dtype=np.float64), novelty[0]

    def _likely_drifts(
        self,
        from_touch: NDArray[np.float64],
        from_opening: NDArray[np.float64],
        both: NDArray[np.float64],
        log_prior: NDArray[np.float64],
        expected: int,
    ) -> NDArray[np.int64]:
        """Return the likeliest drifts by the nearest centre, and the expected one as the last."""
        # Gain by gain: the array of all pairs and classes would leave the processor's cache.
        least = np.array([(one + from_opening).min(axis=1) for one in from_touch])
        nearest = np.maximum(least + both, 0.0).ravel()
        centre = -self._exponent * np.log1p(nearest / self._scale)
        order = np.argsort(-(log_prior + centre))[:_MAX_HYPOTHESES]
        return np.append(order[order != expected], expected)

    def _novelty(
        self,
        distance: NDArray[np.float64],
        own: NDArray[np.float64],
        nearest_sample: NDArray[np.float64],
        tactile: NDArray[np.float64],
        aperture: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        beside = self.discriminant.beside(np.concatenate([tactile, aperture], axis=1))
        second = None
        if self.second is not None:
            second = self.second.distances(tactile[:, : len(self.second.mean)])
        return novelty_features(distance, own, nearest_sample, beside, second)

    def _around(self, own: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (h, C) logarithms of the likelihood around the centre of each class.

        `own` (h, C) are squared distances in standard deviations of each class.
        """
        around: NDArray[np.float64] = -self._exponent * np.log1p(own / self._scale)
        around -= self.spread.log_volume
        return around

    def _near(self, squared: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (h, C) logarithms of the likelihood around the taught grasps of each class."""
        # In place: of many taught grasps, new memory takes as long as the arithmetic.
        density = squared / self._scale
        np.log1p(density, out=density)
        density *= -self._exponent
        density += self.log_weight
        top = density.max(axis=1, keepdims=True)
        density -= top
        first = np.flatnonzero(np.diff(self.sample_class, prepend=-1))
        share = np.add.reduceat(np.exp(density, out=density), first, axis=1)
        near: NDArray[np.float64] = np.log(share + _LEAST_SHARE) + top
        return near

    def _project(
        self, tactile: NDArray[np.float64], aperture: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return (G, r) and (O, r), which add up to a grasp in the discriminant space."""
        lda, n = self.discriminant, tactile.shape[1]
        touch = ((tactile - lda.mean[:n]) / lda.scale[:n]) @ lda.projection[:n]
        opening = ((aperture - lda.mean[n:]) / lda.scale[n:]) @ lda.projection[n:]
        return touch, opening

    def _distances(
        self, touch: NDArray[np.float64], opening: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (G * O, C) squared distances of all pairs of gain and offset to the centres."""
        from_touch, from_opening, both = self._distance_parts(touch, opening)
        squared = from_touch[:, None] + from_opening
        squared += both[..., None]
        return np.maximum(squared, 0.0, out=squared).reshape(-1, squared.shape[2])

    def _distance_parts(
        self, touch: NDArray[np.float64], opening: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return (G, C), (O, C) and (G, O), whose sum is the squared distance to the centres."""
        centres = self.discriminant.centres
        from_touch = (touch**2).sum(axis=1)[:, None] - 2.0 * touch @ centres.T
        from_opening = (opening**2).sum(axis=1)[:, None] - 2.0 * opening @ centres.T
        from_opening += (centres**2).sum(axis=1)
        return from_touch, from_opening, 2.0 * (touch @ opening.T)

    def _to_samples(self, z: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (h, m) squared distances to the taught grasps.

        In parts: products this small take longer where a library shares them among threads.
        """
        squared = np.empty((len(z), len(self.samples)))
        for rows in np.array_split(np.arange(len(z)), _PARTS):
            if len(rows):
                part = slice(rows[0], rows[-1] + 1)
                np.matmul(z[part], self.samples.T, out=squared[part])
        squared *= -2.0
        squared += (self.samples**2).sum(axis=1)
        squared += (z**2).sum(axis=1)[:, None]
        return np.asarray(np.maximum(squared, 0.0, out=squared), dtype=np.float64)

    @property
    def _rank(self) -> float:
        return float(self.samples.shape[1])

    @property
    def _scale(self) -> float:
        return self._rank * self.reach

    @property
    def _exponent(self) -> float:
        return 0.5 * (self._rank + _FREEDOM)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        arrays = {
            f"{prefix}samples": self.samples,
            f"{prefix}sample_class": self.sample_class,
            f"{prefix}log_weight": self.log_weight,
            f"{prefix}reach": np.array(self.reach),
            f"{prefix}has_second": np.array(self.second is not None),
            **self.discriminant.to_arrays(f"{prefix}lda_"),
            **self.spread.to_arrays(f"{prefix}spread_"),
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
            sample_class=arrays[f"{prefix}sample_class"],
            log_weight=arrays[f"{prefix}log_weight"],
            spread=ClassSpread.from_arrays(arrays, f"{prefix}spread_"),
            reach=float(arrays[f"{prefix}reach"]),
        )


_VIRTUAL_WEIGHT = 0.3
"""Weight of a virtual grasp; a real one has 1."""
_MAX_AXES = 48
"""Most axes of a discriminant: beyond these, means of many classes differ by the noise of few
grasps."""
_MIN_SHRINKAGE = 0.15
"""Least shrinkage: grasps in another pose vary in other directions than the taught ones do."""


def fit_class_likelihood(
    training: TrainingSet, taught: NDArray[np.bool_] | None = None
) -> ClassLikelihood:
    """Teach the classes of a view.

    Parameters
    ----------
    training
        Its grasps. A virtual grasp counts 0.3 of a real one; nuisance deviations together count as
        one grasp of each class.
    taught : (n,), optional
        Which grasps are used; classes without any are left out, the rest renumbered.

    Raises
    ------
    ValueError
        The grasps do not show how those of one class vary.
    """
    mask = np.ones(len(training.classes), dtype=np.bool_) if taught is None else taught
    remaining, classes = np.unique(training.classes[mask], return_inverse=True)
    n, n_classes = int(mask.sum()), len(remaining)
    rows, weight = training.features[mask], np.ones(n)
    labels = classes
    if training.virtual is not None and n > n_classes:
        rows = np.concatenate([rows, training.virtual[mask]])
        labels = np.concatenate([classes, classes])
        weight = np.concatenate([weight, np.full(n, _VIRTUAL_WEIGHT)])
    nuisance = None
    if training.nuisance is not None:
        nuisance = training.nuisance[:, mask].reshape(-1, rows.shape[1]) * np.sqrt(n_classes / n)
    fit = partial(
        fit_lda,
        classes=labels,
        n_classes=n_classes,
        min_shrinkage=_MIN_SHRINKAGE,
        n_independent=n,
        weight=weight,
        max_rank=_MAX_AXES,
    )
    first = fit(rows, nuisance=nuisance, keep_whitening=True)
    second = None
    if training.n_second is not None:
        cut = None if nuisance is None else nuisance[:, : training.n_second]
        second = fit(rows[:, : training.n_second], nuisance=cut)
    order = np.argsort(labels, kind="stable")
    labels, weight = labels[order], weight[order]
    total = np.bincount(labels, weights=weight, minlength=n_classes)
    samples = first.project(rows[order])
    return ClassLikelihood(
        discriminant=first,
        second=second,
        samples=samples,
        sample_class=labels,
        log_weight=np.log(weight / total[labels]),
        spread=fit_spread(samples, labels, weight, first.centres),
    )
