"""View of the default recognizer: one discriminant, its temperature and its limit of novelty.

A view answers under each hypothesis of the drift. Distances are divided by the deviation of a grasp
in the directions in which objects do not differ. On another day grasps deviate in all directions, a
new object mostly in those that separate objects.

Teaching takes temperature, limits and even share from held-out grasps.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, logsumexp

from recognition.drift.drift import DriftGrid, DriftPrior
from recognition.features import PadGrid, aperture_features, sizes_mm, touch_features
from recognition.ramp.ramp import Levels, stack_levels
from recognition.records import ArrayRecord
from recognition.statistics.calibration import MOST_TEMPERATURE, blocked_folds, fit_temperature
from recognition.statistics.lda import (
    ClassSpread,
    LinearDiscriminant,
    TaughtSizes,
    fit_class_spread,
    fit_lda,
    fit_sizes,
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSettings:
    """Settings of the teaching and the answers of a view, each with its source in brackets.

    Sources: "6" is decision 6 (docs/decisions), "taught part" the part of recorded grasps that
    teaches, "time" a bound on the time of a teaching.
    """

    # Scores
    freedom: float = 3.0
    """Degrees of freedom of the t distribution of a grasp about its object: heavy tails [6]."""
    outside_power: float = 0.85
    """Power of the spread beside many classes in the unit of distances [taught part: .75 to 1]."""
    outside_axes: float = 3.0
    """Axes between the classes at which half of that power is reached [taught part]."""
    least_distance: float = 0.1
    """Added to squared distances before their logarithm: a lower limit of novelty [taught part]."""
    # Discriminant
    touch_shrinkage: float = 0.2
    """Least share of the target in the covariance by touch alone [taught part]."""
    opening_target: float = 0.1
    """Variance of the opening's features in the target, over that of the touch features [6]."""
    least_unit: float = 0.02
    """Deviation added to that of each feature, in its unit (log, root of share, mm) [6]."""
    most_axes: int = 64
    """Most axes between the classes, those that separate best [time, and the size of a model]."""
    # Many objects
    likely: int = 256
    """Number of classes in an answer: those nearest under any drift [time]."""
    taught: int = 20_000
    """About the most taught grasps to compare a new one with [time, and size]."""
    # Drifts
    log_gain_unit: float = 0.1
    """Unit of drifts of a pad's gain (log), relative to the other pads [taught part]."""
    offset_unit_mm: float = 1.0
    """Unit of drifts of the opening in mm [taught part]."""
    nuisance: float = 0.15
    """Drift, in units, that the discriminant ignores: the remainder between grid steps [6]."""
    made_up: float = 0.5
    """Standard deviation, in units, of simulated drifts of held-out grasps [taught part]."""
    slope_offset_mm: float = 0.5
    """Step of the opening in mm for slopes of features, a step of the grid; of gains a unit [6]."""
    slope_grasps: int = 100
    """About the number of grasps for the mean change of features by a drift [time]."""
    # Held-out grasps
    blocks: int = 3
    """Blocks in time, held out in turn: few and large, because grasps in use are far in time [6].
    """
    held_grasps: int = 2000
    """Most grasps of all blocks for temperature and limits [time]."""
    parts: int = 4
    """Parts of each block, each with its own simulated drift [time]."""
    # Novelty
    novelty_slope: float = 2.0
    """Log odds of a new object for each unit of the novelty [taught part]."""
    known_share: float = 0.97
    """Share of rightly named held-out grasps below the limit of novelty [6]."""
    usual_novelty: float = 3.0
    """Expected mean novelty of held-out grasps, without the size [6]."""
    usual_beyond: tuple[float, float] = (0.8, 1.9)
    """Limits without and with the size, above that mean and one sd of log chi2 [6]."""
    prior_grasps: float = 100.0
    """Weight of these expectations, in grasps [6]."""
    new_quantile: float = 0.05
    """Share of held-out grasps less likely of a taught object than of a new one [taught part]."""
    # Opening on another day
    placing: float = 2.5
    """Spread of the opening between placings of other days, over that of a series [taught part]."""
    least_placing_mm: float = 0.3
    """Least spread of the opening between placings in mm [taught part]."""
    even_grasps: int = 150
    """About the number of held-out grasps for the certainty of names on other days [time]."""
    even_days: int = 8
    """Simulated days of each of them [time]."""
    wrong: float = 0.03
    """Largest share of wrong names among them; below 5 %, because the foam is the same [6]."""


SETTINGS: Final = ViewSettings()
"""Those of all views."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Features:
    """Features of n grasps under G gains and O offsets of the opening."""

    touch: NDArray[np.float64]
    """(n, G, Ft) float64: of the taxels."""
    opening: NDArray[np.float64]
    """(n, O, Fo) float64: of the opening; Fo is 0 and O is 1 if it is not used."""
    sizes_mm: NDArray[np.float64]
    """(n, O, k) float64: sizes by the opening; k is 0 if it is not used."""
    slack_mm: NDArray[np.float64]
    """(O,) float64: tolerance of a size for other placings of an object, in mm."""


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
        Offsets of the opening in mm; without effect if it is not used.
    slack_mm : (O,)
        As `Features.slack_mm`; None for none.
    """

    def by_drift(values: NDArray[np.float64]) -> NDArray[np.float64]:
        n_drifts = len(values) // len(levels)
        return values.reshape(n_drifts, len(levels), values.shape[1]).swapaxes(0, 1)

    pressed = stack_levels([levels.without_drift(gain, 0.0) for gain in log_gains])
    touch = by_drift(touch_features(pressed, grids, opening=opening))
    if not opening:
        none = np.zeros((len(levels), 1, 0))
        return Features(touch=touch, opening=none, sizes_mm=none, slack_mm=np.zeros(1))
    moved = stack_levels([levels.without_drift(0.0, offset) for offset in offsets_mm])
    return Features(
        touch=touch,
        opening=by_drift(aperture_features(moved)),
        sizes_mm=by_drift(sizes_mm(moved)),
        slack_mm=np.zeros(len(offsets_mm)) if slack_mm is None else slack_mm,
    )


class Scores(NamedTuple):
    """Scores of n grasps for K classes under G gains and O offsets of the opening."""

    classes: NDArray[np.int64]
    """(K,) int64: the classes, ascending."""
    scores: NDArray[np.float64]
    """(n, G, O, K) float64: log likelihoods up to a constant of the grasp."""
    novelty: NDArray[np.float64]
    """(n, G, O, 2) float64: logarithm of the squared distance to the nearest taught grasp. The
    second one adds that of the size from the likeliest object: a new object is often a little off
    in both."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ClassModel(ArrayRecord):
    """The classes in the space that separates them."""

    discriminant: LinearDiscriminant
    """The classes."""
    taught: NDArray[np.float32]
    """(n, r) float32: the taught grasps in the discriminant space."""
    taught_classes: NDArray[np.int64]
    """(n,) int64: class of each."""
    sizes: TaughtSizes
    """Sizes of the taught grasps; without dimensions if the opening is not used."""
    spread: ClassSpread | None = None
    """The covariance of each class, by touch alone: there the variation of an object separates it
    from others. With the opening it would only fit the series that taught."""

    def score(self, features: Features, *, likely: int | None = None, also: int = 0) -> Scores:
        """Return scores and novelty of grasps.

        With ``likely`` only so many classes count: those nearest under any drift. The nearest under
        each drift and the class ``also`` are added. None for all.
        """
        model = self.discriminant
        n_touch = features.touch.shape[2]
        touch = (features.touch - model.mean[:n_touch]) / model.scale[:n_touch]
        opening = (features.opening - model.mean[n_touch:]) / model.scale[n_touch:]
        parts = touch @ model.projection[:n_touch], opening @ model.projection[n_touch:]
        z = parts[0][:, :, None] + parts[1][:, None]
        shape, rank = z.shape[:3], z.shape[3]
        unit = np.ones(shape)
        n_outside = len(model.mean) - rank
        if n_outside:
            a, b = touch @ model.variation[:n_touch], opening @ model.variation[n_touch:]
            every = (touch**2).sum(-1)[:, :, None] + (opening**2).sum(-1)[:, None]
            every -= (a**2).sum(-1)[:, :, None] + (b**2).sum(-1)[:, None]
            every -= 2.0 * (a @ b.transpose(0, 2, 1))
            outside = np.maximum(every - (z**2).sum(-1), 0.0) / n_outside
            unit = (1.0 + outside) ** (
                SETTINGS.outside_power * rank / (rank + SETTINGS.outside_axes)
            )
        lengths = (z**2).sum(axis=-1)
        distances = _squared_distances(parts, lengths, model.centres)
        classes, taught = np.arange(len(model.centres)), self.taught
        if likely is not None and likely < len(classes):
            every = (distances / unit[..., None]).reshape(-1, len(classes))
            close = np.argpartition(every.min(axis=0), likely)[:likely]
            classes = np.unique([*close, *every.argmin(axis=1), also])
            distances = distances[..., classes]
            taught = taught[np.isin(self.taught_classes, classes)]
        log_volume: NDArray[np.float64] | float = 0.0
        if self.spread is not None:
            plain = distances.reshape(-1, len(classes))
            by_class = self.spread.distances(z.reshape(-1, rank), plain, classes)
            distances = by_class.reshape(distances.shape)
            log_volume = self.spread.log_volume[classes]
        tails = np.log1p(distances / unit[..., None] / rank)
        scores = -0.5 * (rank + SETTINGS.freedom) * tails - log_volume
        nearest = _squared_distances(parts, lengths, taught.astype(np.float64)).min(axis=-1)
        novelty = np.log(nearest / unit / rank + SETTINGS.least_distance)
        novelty = np.stack([novelty, novelty], axis=-1)
        if features.sizes_mm.size:
            best = classes[scores.argmax(axis=-1)]
            off = self.sizes.distances(features.sizes_mm, features.slack_mm, best)
            novelty[..., 1] += np.log1p(off)
        return Scores(classes, scores, novelty)


def _squared_distances(
    parts: tuple[NDArray[np.float64], NDArray[np.float64]],
    lengths: NDArray[np.float64],
    others: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return (n, G, O, m) squared distances between sums of parts and others (m, r).

    The parts (n, G, r) and (n, O, r) are multiplied by the others before they are added. This is
    much less work than all sums. ``lengths`` (n, G, O) are the squared lengths of the sums.
    """
    of_touch, of_opening = (-2.0 * part @ others.T for part in parts)
    of_opening += (others**2).sum(axis=1)
    squared = of_touch[:, :, None] + of_opening[:, None]
    squared += lengths[..., None]
    return np.asarray(np.maximum(squared, 0.0, out=squared), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class View(ArrayRecord):
    """One taught view: for grasps with the opening, or by touch alone."""

    model: ClassModel
    """The taught classes."""
    temperature: float
    """Log odds are divided by it."""
    limit: NDArray[np.float64]
    """(2,) float64: novelties at which a new object and a taught one are equally likely."""
    log_new: float
    """Log likelihood of a grasp of a new object."""
    placing_mm: float
    """Standard deviation of the opening on one object between placings in mm."""
    even_share: float
    """Share of even probabilities in an answer if the opening's zero is unknown. It limits the
    wrong names under simulated drifts of other days."""

    def __post_init__(self) -> None:
        if not 1.0 / MOST_TEMPERATURE < self.temperature < MOST_TEMPERATURE:
            raise ValueError(
                f"temperature is {self.temperature:g}, must be from 1/{MOST_TEMPERATURE:.0f} to "
                f"{MOST_TEMPERATURE:.0f}"
            )

    def likelihood(
        self, features: Features, *, also: int = 0
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the likely classes (K,) with ``also``, and two values of grasps under each drift.

        These are log likelihoods (n, G, O, K), and the probability of a new object (n, G, O).
        """
        scored = self.model.score(features, likely=SETTINGS.likely, also=also)
        used = 1 + bool(features.sizes_mm.size)
        odds = SETTINGS.novelty_slope * (scored.novelty - self.limit)[..., :used].max(axis=-1)
        return scored.classes, scored.scores / self.temperature, expit(odds)


_AT_A_TIME = 512
"""Grasps whose features are taken at a time: more need more memory and no less time."""

HeldOut = Sequence[tuple[NDArray[np.bool_], ClassModel]]
"""Blocks of grasps, each a mask of rows (n,), and the model that was taught without them."""


def fit_view(
    levels: Levels, grids: Sequence[PadGrid], classes: NDArray[np.int64], *, opening: bool
) -> View:
    """Teach a view.

    Raises ValueError if the grasps do not show the variation of a class.

    Parameters
    ----------
    levels
        The n grasps; those of one class in the order of time.
    classes : (n,)
        Class of each grasp, 0 to C - 1.
    opening
        Whether the opening is used; without it each class has its own covariance.
    """
    teaching = _Teaching(levels=levels, grids=grids, classes=classes, opening=opening)
    held = [(block, teaching.model(~block)) for block in blocked_folds(classes, SETTINGS.blocks)]
    rows, scores, novelty = teaching.held_out_scores(held)
    temperature = fit_temperature(scores, classes[rows])
    # A grasp that would get a wrong name should be UNKNOWN: it must not raise the limit.
    right = scores.argmax(axis=1) == classes[rows]
    whole = teaching.model(np.ones(len(classes), dtype=np.bool_))
    log_sums = logsumexp(scores / temperature, axis=1)
    return View(
        model=whole,
        temperature=temperature,
        limit=_limit(novelty[right] if right.any() else novelty, whole.taught.shape[1]),
        log_new=float(np.quantile(log_sums, SETTINGS.new_quantile)),
        placing_mm=_placing_mm(levels, classes) if opening else 0.0,
        even_share=_even_share(teaching, held, temperature) if opening else 0.0,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class _Teaching:
    """The grasps that teach a view. A drift is (n_pads,) log gains, then the opening in mm."""

    levels: Levels
    grids: Sequence[PadGrid]
    classes: NDArray[np.int64]
    opening: bool

    def per_drift(self, log_gain: float, offset_mm: float) -> NDArray[np.float64]:
        """Return a value for each part of a drift."""
        return np.array([log_gain] * len(self.grids) + [offset_mm] * self.opening)

    @cached_property
    def unit(self) -> NDArray[np.float64]:
        """Unit of each drift component: log gain of each pad, then opening in mm."""
        return self.per_drift(SETTINGS.log_gain_unit, SETTINGS.offset_unit_mm)

    @cached_property
    def every(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Features (n, F) and sizes in mm (n, k) of all grasps, without any drift."""
        n, parts = len(self.levels), []
        for rows in np.array_split(np.arange(n), -(-n // _AT_A_TIME)):
            some = self.undone(self.levels.take(rows), np.zeros(len(self.unit)))
            parts.append((_rows(some), some.sizes_mm[:, 0].copy()))
        features, sizes_mm = map(np.concatenate, zip(*parts, strict=True))
        return features, sizes_mm

    def undone(self, levels: Levels, drift: NDArray[np.float64]) -> Features:
        """Return grasps with one drift undone."""
        gains, offset_mm = drift[None, : len(self.grids)], drift[len(self.grids) :]
        return describe(
            levels, self.grids, opening=self.opening, log_gains=gains, offsets_mm=offset_mm
        )

    @cached_property
    def nuisance(self) -> NDArray[np.float64]:
        """(n_drift, F): change of all features by the drift that the discriminant ignores."""
        n = len(self.levels)
        some = self.levels.take(np.arange(0, n, -(-n // SETTINGS.slope_grasps)))
        slopes = [
            (_rows(self.undone(some, -step)) - _rows(self.undone(some, step))).mean(axis=0)
            / step.sum()
            / 2
            for step in np.diag(self.per_drift(SETTINGS.log_gain_unit, SETTINGS.slope_offset_mm))
        ]
        scale = np.sqrt(len(self.unit)) * SETTINGS.nuisance * self.unit
        return np.asarray(scale[:, None] * np.array(slopes), dtype=np.float64)

    def model(self, rows: NDArray[np.bool_]) -> ClassModel:
        """Return the classes taught by some of the grasps (n,)."""
        features, sizes_mm = (values if rows.all() else values[rows] for values in self.every)
        target = np.ones(features.shape[1])
        if self.opening:
            n_opening = aperture_features(self.levels.take(np.arange(1))).shape[1]
            target[-n_opening:] = SETTINGS.opening_target
        names, numbers = np.unique(self.classes[rows], return_inverse=True)
        discriminant = fit_lda(
            features,
            numbers,
            len(names),
            min_shrinkage=0.0 if self.opening else SETTINGS.touch_shrinkage,
            target=target,
            nuisance=self.nuisance,
            least_unit=SETTINGS.least_unit,
            most_axes=SETTINGS.most_axes,
        )
        z = discriminant.project(features)
        spread = None
        if not self.opening and len(names) > 1:
            spread = fit_class_spread(z, numbers, discriminant.centres)
        chosen = even_in_time(numbers, SETTINGS.taught)
        return ClassModel(
            discriminant=discriminant,
            taught=z[chosen].astype(np.float32),
            taught_classes=numbers[chosen],
            sizes=fit_sizes(sizes_mm, numbers),
            spread=spread,
        )

    def held_out_scores(
        self, held: HeldOut
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """Return rows (n,), scores (n, C) and novelty (n, 2) of held-out grasps that drifted."""
        rng, most = np.random.default_rng(0), SETTINGS.held_grasps // len(held)
        parts = []
        for block, model in held:
            drawn = rng.permutation(np.flatnonzero(block))[:most]
            for part in np.array_split(drawn, SETTINGS.parts):
                if not len(part):
                    continue
                drift = SETTINGS.made_up * self.unit * rng.standard_normal(len(self.unit))
                drifted = self.undone(self.levels.take(part), drift)
                sizes_mm = self.every[1][part, None]
                _, scores, novelty = model.score(replace(drifted, sizes_mm=sizes_mm))
                parts.append((part, scores[:, 0, 0], novelty[:, 0, 0]))
        rows, all_scores, all_novelty = map(np.concatenate, zip(*parts, strict=True))
        return rows, all_scores, all_novelty


def even_in_time(classes: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return at most about ``most`` rows: equal numbers of each class, evenly over its grasps."""
    share = max(2, most // (1 + int(classes.max())))
    groups = [np.flatnonzero(classes == c) for c in np.unique(classes)]
    evenly = [np.linspace(0, len(rows) - 1, min(share, len(rows))).round() for rows in groups]
    return np.concatenate([r[e.astype(np.int64)] for r, e in zip(groups, evenly, strict=True)])


def _rows(features: Features) -> NDArray[np.float64]:
    """Return features under one drift as rows (n, F)."""
    return np.concatenate([features.touch[:, 0], features.opening[:, 0]], axis=1)


def _even_share(teaching: _Teaching, held: HeldOut, temperature: float) -> float:
    """Return the share of even probabilities that names of other days need.

    If the zero of the opening is unknown, touch alone separates objects of different sizes. The
    ``held`` blocks under simulated drifts show the certainty of the models without them.
    """
    levels, grids, classes = teaching.levels, teaching.grids, teaching.classes
    grid, prior = DriftGrid(), DriftPrior()
    rng = np.random.default_rng(0)
    step = max(1, sum(int(block.sum()) for block, _ in held) // SETTINGS.even_grasps)
    best, wrong = [], []
    for block, model in held:
        for row in np.flatnonzero(block)[::step]:
            apart = SETTINGS.log_gain_unit * rng.standard_normal(len(grids))
            leftover_mm = np.ptp(grid.offsets_mm[:2]) * rng.uniform(-0.5, 0.5)
            features = describe(
                levels.take(np.array([row])).without_drift(apart, leftover_mm),
                grids,
                opening=True,
                log_gains=grid.log_gains,
                offsets_mm=grid.offsets_mm,
            )
            likely, scores, _ = model.score(features, likely=SETTINGS.likely)
            scores = scores[0] / temperature
            # A drift of the grasp moves the prior relative to the grasp.
            for log_gain, offset in rng.standard_normal((SETTINGS.even_days, 2)):
                of_gain = -0.5 * (grid.log_gains / prior.log_gain_sd - log_gain) ** 2
                of_offset = -0.5 * (grid.offsets_mm / prior.offset_sd_mm - offset) ** 2
                joint = scores + (of_gain[:, None] + of_offset)[..., None]
                of_each = logsumexp(joint, axis=(0, 1))
                probability = np.exp(of_each - logsumexp(of_each))
                best.append(float(probability.max()))
                wrong.append(likely[probability.argmax()] != classes[row])
    order = np.argsort(best)[::-1]
    within = np.cumsum(np.array(wrong)[order]) <= SETTINGS.wrong * len(order)
    if within.all():
        return 0.0
    # With it this answer has even odds, and less certain ones get no name.
    limit = best[int(order[np.argmin(within)])]
    even = 1.0 / len(np.unique(classes))
    return float(np.clip((limit - 0.5) / max(limit - even, 1e-9), 0.0, 1.0))


def _limit(novelty: NDArray[np.float64], n_axes: int) -> NDArray[np.float64]:
    """Return novelties with even odds (2,), from those of held-out grasps (n, 2) and usual ones.

    ``n_axes`` separate the classes. Few grasps give their mean, but hardly a quantile.
    """
    share = len(novelty) / (len(novelty) + SETTINGS.prior_grasps)
    mean = share * novelty[:, 0].mean() + (1.0 - share) * SETTINGS.usual_novelty
    usual = mean + np.sqrt(2.0 / (1 + n_axes)) + np.array(SETTINGS.usual_beyond)
    held = np.quantile(novelty, SETTINGS.known_share, axis=0)
    return np.asarray(share * held + (1.0 - share) * usual)


def _placing_mm(levels: Levels, classes: NDArray[np.int64]) -> float:
    """Return the standard deviation of the opening on one object between days, in mm."""
    touch = sizes_mm(levels)[:, 1]
    variance = [touch[classes == c].var(ddof=1) for c in np.unique(classes)]
    return max(SETTINGS.least_placing_mm, SETTINGS.placing * float(np.sqrt(np.mean(variance))))
