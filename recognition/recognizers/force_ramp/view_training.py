"""Teaching of a view: its discriminant; temperature, limits and even share on held-out grasps."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift.grid import DriftGrid, DriftPrior
from recognition.features import PadGrid, aperture_features, sizes_mm
from recognition.ramp.levels import Levels
from recognition.recognizers.force_ramp.view import SETTINGS, ClassModel, Features, View, describe
from recognition.statistics.calibration import blocked_folds, fit_temperature
from recognition.statistics.classes import fit_class_spread, fit_sizes
from recognition.statistics.lda import fit_lda

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
    whole = teaching.model(np.ones(len(classes), dtype=np.bool_))
    known = logsumexp(scores / temperature, axis=1)
    return View(
        model=whole,
        temperature=temperature,
        limit=_limit(novelty, whole.taught.shape[1]),
        log_new=float(np.quantile(known, SETTINGS.new_quantile)),
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
        """Unit of each part of a drift."""
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
        features, sizes_mm = (one if rows.all() else one[rows] for one in self.every)
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
