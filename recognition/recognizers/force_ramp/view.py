"""View of the default recogniser: one discriminant, its temperature and its limit of novelty.

A view answers under each hypothesis of the drift. Distances are measured in units of how far a
grasp lies off in the directions in which objects do not differ: on another day grasps lie off in
all directions, a new object mostly in those that separate objects.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logsumexp

from recognition.drift.drift import shifted_levels
from recognition.drift.grid import DriftGrid, DriftPrior
from recognition.features.aperture import aperture_features, sizes_mm
from recognition.features.footprint import PadGrid
from recognition.features.groups import FeatureView, touch_features
from recognition.ramp.levels import Levels, stack_levels
from recognition.statistics.calibration import blocked_folds, fit_temperature, kept_temperature
from recognition.statistics.class_spread import ClassSpread, fit_class_spread
from recognition.statistics.lda import LinearDiscriminant, fit_lda, squared_distances
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
_UNIT = (0.1, 1.0)
"""Unit of drifts: of the logarithm of a gain, of the opening in mm."""
_NUISANCE = 0.15
"""Drift, in these units, that the discriminant is taught as a nuisance: what the steps of the grid
leave over."""
_MADE_UP = 0.5
"""Standard deviation, in these units, of made-up drifts of the held-out grasps that calibrate."""
_LEAST_DISTANCE = 0.1
"""Added to squared distances before their logarithm: nearer grasps are no less novel."""
_TOUCH_SHRINKAGE = 0.2
"""Least shrinkage of the covariance by touch alone."""
_OPENING_TARGET = 0.1
"""Variance of the opening's features, in that of touch, in the target of the shrinkage: hundreds of
features of touch repeat each other, which few grasps do not show, and as independent ones would
outweigh the opening. Chosen on the taught part of recorded objects, each among its nearest."""
_LEAST_UNIT = 0.02
"""Least deviation of a feature within an object: of a logarithm, a root of a share, a length in mm.
Rows of taxels that few grasps never load show none, and one later grasp there would be far off.
Chosen on fours of look-alikes, taught part of recorded objects: 0.01 to 0.03 are as good."""
_SLOPE_STEPS = (0.1, 0.5)
"""Steps of the central difference for slopes: of the logarithm of a gain, of the opening in mm."""
_SLOPE_GRASPS = 100
"""About as many grasps show how a drift changes the features in the mean."""
_BLOCKS = 3
"""Blocks in time, held out in turn: few large ones, as grasps in use lie far in time."""
_PARTS = 4
"""Parts of each block, each with a made-up drift of its own."""
_KEPT = 0.97
"""Share of held-out grasps of taught objects whose novelty is no new object's."""
_USUAL_NOVELTY = 3.0
"""Novelty that is expected of held-out grasps in the mean, without the size."""
_USUAL_BEYOND = (0.8, 1.9)
"""How far the limits, without the size and with it, are expected beyond that mean and about one
standard deviation of the logarithm of chi squared: the fewer axes separate the classes, the more
grasps of one object stray."""
_PRIOR_GRASPS = 100.0
"""Weight of these expectations, in grasps. Chosen on two to thirty objects with three to twenty
grasps each, recorded and simulated, by the strangers that get a name and the taught ones that get
none."""
_NOVELTY_SLOPE = 2.0
"""Log odds of a new object for each unit of the novelty."""
_NEW_QUANTILE = 0.05
"""Share of held-out grasps that are less likely under all taught objects than a new object is."""
_PLACING = 2.5
"""Spread of the opening on one object between placings of different days, in that of a series."""
_LEAST_PLACING_MM = 0.3
"""Least spread of the opening between placings in mm."""
_PAD_LOG_GAIN_SD = 0.1
"""Standard deviation of the logarithm of what the gain of each pad drifts by beside the common."""
_DOUBT_GRASPS, _DOUBT_DAYS = 150, 8
"""About as many held-out grasps show how sure names of other days are, each on some such days."""
_WRONG = 0.03
"""Largest share of wrong names among them: below the 5 % that are held on other days, as no other
foam is made up, and held-out grasps are few."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Features of n grasps under G gains and O offsets of the opening."""

    touch: NDArray[np.float64]
    """(n, G, Ft) float64: of the taxels."""
    opening: NDArray[np.float64]
    """(n, O, Fo) float64: of the opening; Fo is 0 and O is 1 where it is not used."""
    sizes_mm: NDArray[np.float64]
    """(n, O, k) float64: sizes by the opening; k is 0 where it is not used."""
    slack_mm: NDArray[np.float64]
    """(O,) float64: how far a size may lie off because objects lie differently, in mm."""


def describe(
    levels: Levels,
    grids: Sequence[PadGrid],
    *,
    opening: bool,
    log_gains: NDArray[np.float64],
    offsets_mm: NDArray[np.float64],
    slack_mm: NDArray[np.float64] | None = None,
) -> Features:
    """Return features of grasps with each of some drifts undone.

    Parameters
    ----------
    levels
        The n grasps.
    log_gains : (G,) or (G, P)
        Logarithms of gains, common to the pads or of each.
    offsets_mm : (O,)
        Offsets of the opening in mm; without effect where it is not used.
    slack_mm : (O,)
        As `Features.slack_mm`; None for none.
    """

    def by_drift(values: NDArray[np.float64]) -> NDArray[np.float64]:
        n_drifts = len(values) // len(levels)
        return values.reshape(n_drifts, len(levels), values.shape[1]).swapaxes(0, 1)

    pressed = stack_levels([shifted_levels(levels, gain, 0.0) for gain in log_gains])
    touch = by_drift(touch_features(pressed, grids, FeatureView.FORCE_RAMP, opening=opening))
    if not opening:
        none = np.zeros((len(levels), 1, 0))
        return Features(touch=touch, opening=none, sizes_mm=none, slack_mm=np.zeros(1))
    moved = stack_levels([shifted_levels(levels, 0.0, offset) for offset in offsets_mm])
    return Features(
        touch=touch,
        opening=by_drift(aperture_features(moved)),
        sizes_mm=by_drift(sizes_mm(moved)),
        slack_mm=np.zeros(len(offsets_mm)) if slack_mm is None else slack_mm,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassModel:
    """The classes in the space that separates them."""

    discriminant: LinearDiscriminant
    """The classes."""
    taught: NDArray[np.float64]
    """(n, r) float64: the taught grasps in the discriminant space."""
    sizes: TaughtSizes
    """Sizes of the taught grasps; of no dimension where the opening is not used."""
    spread: ClassSpread | None = None
    """The covariance of each class beside the shared one, by touch alone: there the variation of an
    object separates it from others. With the opening it would only fit the series that taught."""

    def score(self, features: Features) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return scores (n, G, O, C) and the novelty (n, G, O, 2) of grasps.

        Scores are log likelihoods up to a constant of the grasp; the novelty is the logarithm of
        the squared distance to the nearest taught grasp, without and with that of the size from
        those of the likeliest object: a new object is often a little off in both.
        """
        model = self.discriminant
        n_touch = features.touch.shape[2]
        touch = (features.touch - model.mean[:n_touch]) / model.scale[:n_touch]
        opening = (features.opening - model.mean[n_touch:]) / model.scale[n_touch:]
        z = (touch @ model.projection[:n_touch])[:, :, None]
        z = z + (opening @ model.projection[n_touch:])[:, None]
        shape, rank = z.shape[:3], z.shape[3]
        unit = np.ones(shape)
        n_beside = len(model.mean) - rank
        if n_beside:
            a, b = touch @ model.whitening[:n_touch], opening @ model.whitening[n_touch:]
            every = (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None]
            every = every + 2.0 * (a @ b.transpose(0, 2, 1))
            beside = np.maximum(every - (z**2).sum(-1), 0.0) / n_beside
            unit = (1.0 + beside) ** (_BESIDE_POWER * rank / (rank + _PRIOR_AXES))
        z = z.reshape(-1, rank)
        distances = squared_distances(z, model.centres)
        log_volume: NDArray[np.float64] | float = 0.0
        if self.spread is not None:
            distances, log_volume = self.spread.distances(z, distances), self.spread.log_volume
        tails = np.log1p(distances / unit.reshape(-1, 1) / rank)
        scores = -0.5 * (rank + _FREEDOM) * tails - log_volume
        nearest = squared_distances(z, self.taught).min(axis=1).reshape(shape)
        scores = scores.reshape(*shape, -1)
        novelty = np.log(nearest / unit / rank + _LEAST_DISTANCE)
        novelty = np.stack([novelty, novelty], axis=-1)
        if features.sizes_mm.size:
            off = self.sizes.distances(features.sizes_mm, features.slack_mm)
            best = scores.argmax(axis=-1)[..., None]
            novelty[..., 1] += np.log1p(np.take_along_axis(off[:, None], best, axis=-1)[..., 0])
        return scores, novelty


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View:
    """One view: what it was taught, for grasps with the opening or by touch alone."""

    model: ClassModel
    """The taught classes."""
    temperature: float
    """Log odds are divided by it."""
    limit: NDArray[np.float64]
    """(2,) float64: novelties at which a grasp is as likely of a new object as of a taught one."""
    log_new: float
    """Log likelihood of a grasp of a new object."""
    placing_mm: float
    """Standard deviation of the opening on one object between placings in mm."""
    doubt: float
    """Share of even probabilities in an answer where nothing is known of the opening's zero: with
    it few enough names of made-up other days are wrong."""

    def likelihood(self, features: Features) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return log likelihoods (n, G, O, C), and the probability of a new object (n, G, O)."""
        scores, novelty = self.model.score(features)
        used = 1 + bool(features.sizes_mm.size)
        odds = _NOVELTY_SLOPE * (novelty - self.limit)[..., :used].max(axis=-1)
        return scores / self.temperature, expit(odds)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        spread = self.model.spread
        return {
            **self.model.discriminant.to_arrays(f"{prefix}discriminant_"),
            **({} if spread is None else spread.to_arrays(f"{prefix}spread_")),
            **self.model.sizes.to_arrays(f"{prefix}sizes_"),
            f"{prefix}taught": self.model.taught,
            f"{prefix}limit": self.limit,
            f"{prefix}temperature": np.array(self.temperature),
            **{f"{prefix}{name}": np.array(getattr(self, name)) for name in _NUMBERS},
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        spread, has_spread = f"{prefix}spread_", f"{prefix}spread_centres" in arrays
        return cls(
            model=ClassModel(
                discriminant=LinearDiscriminant.from_arrays(arrays, f"{prefix}discriminant_"),
                taught=arrays[f"{prefix}taught"],
                sizes=TaughtSizes.from_arrays(arrays, f"{prefix}sizes_"),
                spread=ClassSpread.from_arrays(arrays, spread) if has_spread else None,
            ),
            limit=arrays[f"{prefix}limit"],
            temperature=kept_temperature(arrays[f"{prefix}temperature"]),
            **{name: float(arrays[f"{prefix}{name}"]) for name in _NUMBERS},
        )


_NUMBERS = ("log_new", "placing_mm", "doubt")
"""Further attributes of a `View` that are single numbers."""


def fit_view(
    levels: Levels, grids: Sequence[PadGrid], classes: NDArray[np.int64], *, opening: bool
) -> View:
    """Teach a view.

    Raises ValueError where the grasps do not show how those of a class vary.

    Parameters
    ----------
    levels
        The n grasps; those of one class in the order of time.
    classes : (n,)
        Class of each grasp, 0 to C - 1.
    opening
        Whether the opening is used; without it each class has a covariance of its own.
    """
    n_pads = len(grids)
    unit = np.array([_UNIT[0]] * n_pads + [_UNIT[1]])[: n_pads + opening]

    def undone(some: Levels, drift: NDArray[np.float64]) -> Features:
        gains, offset_mm = drift[None, :n_pads], drift[n_pads:]
        return describe(some, grids, opening=opening, log_gains=gains, offsets_mm=offset_mm)

    def vectors(features: Features) -> NDArray[np.float64]:
        return np.concatenate([features.touch[:, 0], features.opening[:, 0]], axis=1)

    some = levels.take(np.arange(0, len(levels), -(-len(levels) // _SLOPE_GRASPS)))
    steps = np.diag([_SLOPE_STEPS[0]] * n_pads + [_SLOPE_STEPS[1]])[: len(unit), : len(unit)]
    slopes = [
        (vectors(undone(some, -step)) - vectors(undone(some, step))).mean(axis=0) / step.sum() / 2
        for step in steps
    ]
    nuisance = np.sqrt(len(unit)) * _NUISANCE * unit[:, None] * np.array(slopes)
    plain = undone(levels, np.zeros(len(unit)))
    every = vectors(plain)
    target = np.ones(every.shape[1])
    target[len(target) - plain.opening.shape[2] :] = _OPENING_TARGET

    def teach(rows: NDArray[np.bool_]) -> ClassModel:
        names, numbers = np.unique(classes[rows], return_inverse=True)
        discriminant = fit_lda(
            every[rows],
            numbers,
            len(names),
            min_shrinkage=0.0 if opening else _TOUCH_SHRINKAGE,
            target=target,
            nuisance=nuisance,
            least_unit=_LEAST_UNIT,
        )
        z = discriminant.project(every[rows])
        spread = None
        if not opening and len(names) > 1:
            spread = fit_class_spread(z, numbers, discriminant.centres)
        return ClassModel(
            discriminant=discriminant,
            taught=z,
            sizes=fit_sizes(plain.sizes_mm[rows, 0], numbers),
            spread=spread,
        )

    rng = np.random.default_rng(0)
    scores, novelty, rows = [], [], []
    held = [(block, teach(~block)) for block in blocked_folds(classes, _BLOCKS)]
    for block, model in held:
        for part in np.array_split(rng.permutation(np.flatnonzero(block)), _PARTS):
            if not len(part):
                continue
            drift = _MADE_UP * unit * rng.standard_normal(len(unit))
            made_up = undone(levels.take(part), drift)
            found = model.score(replace(made_up, sizes_mm=plain.sizes_mm[part]))
            scores.append(found[0][:, 0, 0])
            novelty.append(found[1][:, 0, 0])
            rows.append(part)
    score = np.concatenate(scores)
    temperature = fit_temperature(score, classes[np.concatenate(rows)])
    whole = teach(np.ones(len(classes), dtype=np.bool_))
    return View(
        model=whole,
        temperature=temperature,
        limit=_limit(np.concatenate(novelty), whole.taught.shape[1]),
        log_new=float(np.quantile(logsumexp(score / temperature, axis=1), _NEW_QUANTILE)),
        placing_mm=_placing_mm(levels, classes) if opening else 0.0,
        doubt=_doubt(levels, grids, classes, held, temperature) if opening else 0.0,
    )


def _doubt(
    levels: Levels,
    grids: Sequence[PadGrid],
    classes: NDArray[np.int64],
    held: Sequence[tuple[NDArray[np.bool_], ClassModel]],
    temperature: float,
) -> float:
    """Return the share of even probabilities that names of other days need.

    Where the zero of the opening is unknown, touch alone separates objects of different sizes. How
    sure it really is, blocks that are ``held`` out show to the models without them, under
    made-up drifts.
    """
    grid, prior = DriftGrid(), DriftPrior()
    rng = np.random.default_rng(0)
    step = max(1, sum(int(block.sum()) for block, _ in held) // _DOUBT_GRASPS)
    best, wrong = [], []
    for block, model in held:
        for row in np.flatnonzero(block)[::step]:
            apart = _PAD_LOG_GAIN_SD * rng.standard_normal(len(grids))
            leftover_mm = np.ptp(grid.offsets_mm[:2]) * rng.uniform(-0.5, 0.5)
            features = describe(
                shifted_levels(levels.take(np.array([row])), apart, leftover_mm),
                grids,
                opening=True,
                log_gains=grid.log_gains,
                offsets_mm=grid.offsets_mm,
            )
            scores = model.score(features)[0][0] / temperature
            # A drift of the grasp moves the prior against the grasp as it was.
            for log_gain, offset in rng.standard_normal((_DOUBT_DAYS, 2)):
                of_gain = -0.5 * (grid.log_gains / prior.log_gain_sd - log_gain) ** 2
                of_offset = -0.5 * (grid.offsets_mm / prior.offset_sd_mm - offset) ** 2
                joint = scores + (of_gain[:, None] + of_offset)[..., None]
                probability = np.exp(logsumexp(joint, axis=(0, 1)) - logsumexp(joint))
                best.append(float(probability.max()))
                wrong.append(int(probability.argmax()) != classes[row])
    order = np.argsort(best)[::-1]
    within = np.cumsum(np.array(wrong)[order]) <= _WRONG * len(order)
    if within.all():
        return 0.0
    # With it this answer is as likely as not right, and those that are less sure get no name.
    limit = best[int(order[np.argmin(within)])]
    even = 1.0 / len(np.unique(classes))
    return float(np.clip((limit - 0.5) / max(limit - even, 1e-9), 0.0, 1.0))


def _limit(novelty: NDArray[np.float64], n_axes: int) -> NDArray[np.float64]:
    """Return novelties with even odds (2,), from those of held-out grasps (n, 2) and what is usual.

    ``n_axes`` separate the classes. A quantile of few grasps is hardly known, their mean sooner.
    """
    share = len(novelty) / (len(novelty) + _PRIOR_GRASPS)
    mean = share * novelty[:, 0].mean() + (1.0 - share) * _USUAL_NOVELTY
    usual = mean + np.sqrt(2.0 / (1 + n_axes)) + np.array(_USUAL_BEYOND)
    held = np.quantile(novelty, _KEPT, axis=0)
    return np.asarray(share * held + (1.0 - share) * usual)


def _placing_mm(levels: Levels, classes: NDArray[np.int64]) -> float:
    """Return how far the opening on one object differs between placings of different days."""
    touch = sizes_mm(levels)[:, 1]
    variance = [touch[classes == c].var(ddof=1) for c in np.unique(classes)]
    return max(_LEAST_PLACING_MM, _PLACING * float(np.sqrt(np.mean(variance))))
