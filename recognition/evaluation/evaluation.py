"""Evaluation of a recognizer: accuracy with intervals, fusion, untaught objects, drift tracking."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise
from types import MappingProxyType
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtri

from recognition.drift.drift import DriftFollowing
from recognition.evaluation.splits import TrainTest
from recognition.grasp import Grasp, by_label, series_of
from recognition.recognizer import UNKNOWN, Posterior, Recognizer, Trainer
from recognition.statistics import fusion

_N_DRAWS = 2000
"""Samples of a bootstrap."""


def confusion_matrix(
    truth: Sequence[str], answers: Sequence[str], labels: Sequence[str]
) -> NDArray[np.int64]:
    """Return (C, C) counts: row = true label, column = answer, in the order of `labels`.

    Raises ValueError where the lengths differ or a label is not listed.
    """
    if len(truth) != len(answers):
        raise ValueError(f"{len(truth)} truths and {len(answers)} answers")
    index = {label: i for i, label in enumerate(labels)}
    missing = sorted({*truth, *answers} - set(index))
    if missing:
        raise ValueError(f"labels {missing} are not listed")
    table = np.zeros((len(labels), len(labels)), dtype=np.int64)
    for true, answer in zip(truth, answers, strict=True):
        table[index[true], index[answer]] += 1
    return table


def wilson_interval(successes: float, n: int) -> tuple[float, float]:
    """Return the Wilson score interval of a proportion at 95 %; (0, 1) where n is 0.

    Raises ValueError where successes are not from 0 to n.
    """
    if not 0 <= successes <= n:
        raise ValueError(f"{successes} of {n} is no proportion")
    if n == 0:
        return 0.0, 1.0
    z = float(ndtri(0.975))
    p = successes / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * float(np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)))
    return max(0.0, min(p, centre - half)), min(1.0, max(p, centre + half))


def auroc(
    negative: ArrayLike, positive: ArrayLike, weights: tuple[ArrayLike, ArrayLike] | None = None
) -> NDArray[np.float64]:
    """Return the probability that a positive score exceeds a negative one, ties counted half.

    NaN where either is empty or has no weight.

    Parameters
    ----------
    negative, positive : (n,), (m,)
        Scores.
    weights
        Weights (..., n) and (..., m) of the scores; the result has their leading dimensions.
    """
    low = np.asarray(negative, dtype=np.float64)
    high = np.asarray(positive, dtype=np.float64)
    plain = np.ones(len(low)), np.ones(len(high))
    of_low, of_high = (np.asarray(weight, dtype=np.float64) for weight in weights or plain)
    order = np.argsort(low)
    below = np.cumsum(of_low[..., order], axis=-1)
    below = np.concatenate([np.zeros((*below.shape[:-1], 1)), below], axis=-1)
    first = np.searchsorted(low[order], high, side="left")
    last = np.searchsorted(low[order], high, side="right")
    beaten = 0.5 * (below[..., first] + below[..., last])
    with np.errstate(invalid="ignore"):
        area = np.sum(beaten * of_high, axis=-1) / (below[..., -1] * np.sum(of_high, axis=-1))
    return np.asarray(area, dtype=np.float64)


def object_weights(objects: Sequence[str], seed: int = 0) -> dict[str, NDArray[np.float64]]:
    """Return how often each object is in each of `_N_DRAWS` bootstrap samples of the objects.

    Grasps of one object in one series resemble each other, so objects are drawn, not grasps.
    """
    names = sorted(set(objects))
    rng = np.random.default_rng(seed)
    counts = rng.multinomial(len(names), np.full(len(names), 1.0 / len(names)), size=_N_DRAWS)
    return dict(zip(names, counts.T.astype(np.float64), strict=True))


def percentile_interval(draws: ArrayLike) -> tuple[float, float]:
    """Return the 95 % percentile interval of bootstrap draws, NaN ones left out."""
    low, high = np.nanpercentile(np.asarray(draws, dtype=np.float64), [2.5, 97.5])
    return float(low), float(high)


_BOOTSTRAP_OBJECTS = 12
"""Fewest objects for a bootstrap: with 3 to 8, 77 to 90 % of simulated shares are in the interval
that should hold 95 %."""


def interval_by_object(
    right: Sequence[bool], objects: Sequence[str], *, fewest: int = _BOOTSTRAP_OBJECTS
) -> tuple[float, float]:
    """Return the 95 % interval of a share by a bootstrap of objects (cluster bootstrap).

    With fewer than ``fewest`` objects, or where all grasps are right or all wrong, it is Wilson's
    with one trial for each object. (0, 1) without grasps, or for different results of one object.
    """
    if not right or len(set(right)) > len(set(objects)):
        return 0.0, 1.0
    weights = object_weights(objects)
    if len(weights) < fewest or len(set(right)) < 2:
        return wilson_interval(sum(right) / len(right) * len(weights), len(weights))
    each = np.array([weights[name] for name in objects])
    return percentile_interval(np.asarray(right, dtype=np.float64) @ each / each.sum(axis=0))


_BEFORE = 10
"""Grasps of a shift that are tracked before the first counted grasp."""
MIN_LABELS_FOR_UNKNOWN = 4
"""Fewest labels for tests of unknown objects: with fewer, too few would remain to be taught."""
_UNKNOWN_EDGES = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
"""Edges of the rows of the reliability of ``unknown``."""
_CHUNK = 64
"""Grasps answered in one piece of work: long enough for a small overhead."""

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


class Mapper(Protocol):
    """Applies a function to many items, perhaps elsewhere; returns the results in order."""

    def __call__(
        self, work: Callable[[_Item], _Result], items: Sequence[_Item], /
    ) -> Iterable[_Result]:
        """Return ``work(item)`` for each item; work and items can be pickled."""


def one_by_one(work: Callable[[_Item], _Result], items: Sequence[_Item], /) -> Iterable[_Result]:
    """Apply a function in this process, one item after the other; a `Mapper`."""
    return map(work, items)


@dataclass(frozen=True, slots=True, kw_only=True)
class ShiftFigures:
    """Results of a recognizer that follows the drift, over grasps in a mixed order."""

    before: int
    """Number of grasps of the shift before the first counted one."""
    n: int
    """Number of counted grasps."""
    accuracy: float
    interval: tuple[float, float]
    """Share of counted grasps with the right likeliest label, and its 95 % interval by objects."""
    named_right: float
    named_wrong: float
    """Shares of counted grasps that are named rightly and wrongly."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evaluation:
    """Results of a recognizer on grasps that did not teach it."""

    trainer: str
    uses_aperture: bool
    """The recognizer."""
    labels: tuple[str, ...]
    """The taught objects."""
    n: int
    """Number of tested grasps of taught objects."""
    n_untaught: int
    """Number of tested grasps of other objects; no accuracy includes them."""
    single_accuracy: float
    interval: tuple[float, float]
    """Share of grasps with the right likeliest label, and its 95 % interval by objects (cluster
    bootstrap): grasps of one object in one series resemble each other."""
    fused_accuracy: Mapping[int, float]
    fused_interval: Mapping[int, tuple[float, float]]
    """The same for k consecutive grasps of one label in time, by k; no grasp counts twice."""
    named_right: float
    named_wrong: float
    """Share of tested grasps of taught objects that one grasp names rightly and wrongly; the others
    are called UNKNOWN."""
    unknown_auroc: float
    """Area under the curve of ``unknown`` for objects that were left out of teaching against the
    others; NaN where it was not measured."""
    auroc_interval: tuple[float, float]
    """Its 95 % interval by objects."""
    unknown_reliability: tuple[tuple[float, float, int, int], ...]
    """Rows of ``unknown`` in that test: lower and upper edge, grasps, and those of left-out
    objects. Objects are left out one group at a time; their share is the prior of the test."""
    confusion: NDArray[np.int64]
    """(C, C) int64: row = true label, column = likeliest label."""
    shift: ShiftFigures | None = None
    """Results of the same grasps in a mixed order; None for a recognizer without drift tracking."""

    @property
    def confused(self) -> tuple[tuple[str, str, int], ...]:
        """True label, answered label and number of each confusion; most frequent first."""
        counts = self.confusion.tolist()
        pairs = [
            (truth, answer, counts[row][column])
            for row, truth in enumerate(self.labels)
            for column, answer in enumerate(self.labels)
            if row != column and counts[row][column]
        ]
        return tuple(sorted(pairs, key=lambda pair: -pair[2]))


def evaluate(
    parts: Sequence[TrainTest],
    trainer: Trainer,
    fuse: Sequence[int] = (1, 2, 3, 5),
    seed: int = 0,
    *,
    unknown_groups: int = 6,
    mapper: Mapper = one_by_one,
) -> Evaluation:
    """Teach a recognizer with one part of the grasps and test it on the other, for each pair.

    Raises ValueError where no tested grasp is of a taught object, or a grasp has no label.

    Parameters
    ----------
    parts
        Pairs of labelled grasps to teach and to test; no grasp may be in both of a pair. The
        answers of all pairs count together; grasps of different pairs are not fused.
    fuse
        Numbers of grasps to fuse.
    seed
        Seed of the random sets of grasps.
    unknown_groups
        Number of groups of labels. Each group in turn is left out of teaching and must then be
        found unknown. One more recognizer is taught for each group; 0 for no test.
    mapper
        Maps the work to processes or machines; the results do not depend on it.
    """
    known: list[_Answer] = []
    runs: list[list[_Answer]] = []
    scored: list[_Scores] = []
    labels: set[str] = set()
    n_untaught = 0
    shift = None
    for train, test in parts:
        recognizer = trainer.fit(train)
        labels.update(recognizer.labels)
        ordered = [series_of(members) for members in by_label(test).values()]
        series = [run for every in ordered for run in every if run[0].label in recognizer.labels]
        here = [g for members in series for g in members]
        untaught = [g for g in test if g.label not in recognizer.labels]
        answered = _answers(recognizer, here, mapper)
        known += answered
        # A sequence grasps one part: no individual stands in for another.
        numbered = iter(answered)
        runs += [list(islice(numbered, len(members))) for members in series]
        scored += _leave_out(train, here, trainer, unknown_groups, mapper)
        if untaught and here:
            n_untaught += len(untaught)
            scored.append((answered, _answers(recognizer, untaught, mapper)))
        if len(parts) == 1:
            shift = evaluate_shift(recognizer, here, seed)
    if not known:
        n_tested = sum(len(test) for _, test in parts)
        raise ValueError(
            f"none of the {n_tested} tested grasps is of a taught object {sorted(labels)}"
        )
    accuracy, shares = _shares(known)
    fused = {k: _consecutive(runs, k) for k in fuse}
    area, auroc_interval = _separation(scored)
    best = [p.best for p, _ in known]
    return Evaluation(
        trainer=trainer.name,
        uses_aperture=trainer.uses_aperture,
        labels=tuple(sorted(labels)),
        n=len(known),
        n_untaught=n_untaught,
        single_accuracy=accuracy,
        **shares,
        fused_accuracy=MappingProxyType({k: share for k, (share, _) in fused.items()}),
        fused_interval=MappingProxyType({k: interval for k, (_, interval) in fused.items()}),
        unknown_auroc=area,
        auroc_interval=auroc_interval,
        unknown_reliability=_reliability(scored),
        confusion=confusion_matrix([label for _, label in known], best, tuple(sorted(labels))),
        shift=shift,
    )


_Answer = tuple[Posterior, str]
"""Posterior and label of a tested grasp."""
_Scores = tuple[Sequence[_Answer], Sequence[_Answer]]
"""Answers to tested grasps of taught labels, and of those left out."""


def _shares(answered: Sequence[_Answer]) -> tuple[float, dict[str, Any]]:
    """Return the accuracy, and its interval and the shares of names as arguments."""
    right = [p.best == label for p, label in answered]
    named = np.array([(p.name == label, p.name not in (label, UNKNOWN)) for p, label in answered])
    named_right, named_wrong = named.mean(axis=0).tolist()
    return sum(right) / len(right), {
        "interval": interval_by_object(right, [label for _, label in answered]),
        "named_right": named_right,
        "named_wrong": named_wrong,
    }


def evaluate_shift(recognizer: object, grasps: Sequence[Grasp], seed: int) -> ShiftFigures | None:
    """Return results over labelled grasps of taught objects in a mixed order, with drift tracking.

    None where the recognizer does not follow the drift, or there are too few grasps.
    """
    if not isinstance(recognizer, DriftFollowing) or len(grasps) <= _BEFORE:
        return None
    answered: list[_Answer] = []
    for number, i in enumerate(np.random.default_rng(seed).permutation(len(grasps)).tolist()):
        grasp = grasps[i]
        if number >= _BEFORE:
            answered.append((recognizer.posterior(grasp), grasp.label))
        recognizer = recognizer.follow(grasp)
    accuracy, shares = _shares(answered)
    return ShiftFigures(before=_BEFORE, n=len(answered), accuracy=accuracy, **shares)


def _answers(recognizer: Recognizer, grasps: Sequence[Grasp], mapper: Mapper) -> list[_Answer]:
    """Return posterior and label of each grasp, in order."""
    chunks = [grasps[i : i + _CHUNK] for i in range(0, len(grasps), _CHUNK)]
    return [answer for part in mapper(partial(_answers_of, recognizer), chunks) for answer in part]


def _answers_of(recognizer: Recognizer, grasps: Sequence[Grasp]) -> list[_Answer]:
    return [(recognizer.posterior(g), g.label) for g in grasps]


def _leave_out(
    train: Sequence[Grasp], test: Sequence[Grasp], trainer: Trainer, n_groups: int, mapper: Mapper
) -> list[_Scores]:
    """Return the scores for each group of left-out labels."""
    labels = sorted({g.label for g in train})
    if min(len(labels), len({g.label for g in test})) < MIN_LABELS_FOR_UNKNOWN:
        return []
    n_groups = min(n_groups, len(labels))
    groups = [frozenset(labels[group::n_groups]) for group in range(n_groups)]
    groups = [
        out for out in groups if len(labels) - len(out) >= 2 and any(g.label in out for g in test)
    ]
    return list(mapper(partial(_scores_without, train, test, trainer), groups))


def _scores_without(
    train: Sequence[Grasp], test: Sequence[Grasp], trainer: Trainer, out: frozenset[str]
) -> _Scores:
    recognizer = trainer.fit([g for g in train if g.label not in out])
    answered = _answers_of(recognizer, test)
    known = [answer for answer in answered if answer[1] not in out]
    return known, [answer for answer in answered if answer[1] in out]


def _separation(scored: Sequence[_Scores]) -> tuple[float, tuple[float, float]]:
    """Return the mean area under the curve, and its 95 % interval; NaN without scores."""
    if not scored:
        return float("nan"), (float("nan"), float("nan"))
    weights = object_weights([label for group in scored for part in group for _, label in part])
    areas, drawn = [], []
    for group in scored:
        known, new = ([p.unknown for p, _ in part] for part in group)
        each = tuple(np.array([weights[label] for _, label in part]).T for part in group)
        areas.append(auroc(known, new))
        drawn.append(auroc(known, new, (each[0], each[1])))
    # A draw may have none of the objects of a group; the mean of the others counts.
    with_group = [draw[np.isfinite(draw)] for draw in np.array(drawn).T]
    means = [np.mean(draw) for draw in with_group if len(draw)]
    area, n = float(np.mean(areas)), len(weights)
    few = n < _BOOTSTRAP_OBJECTS or area in (0.0, 1.0)
    return area, wilson_interval(area * n, n) if few else percentile_interval(means)


def _reliability(scored: Sequence[_Scores]) -> tuple[tuple[float, float, int, int], ...]:
    known, new = (
        np.histogram([p.unknown for group in scored for p, _ in group[part]], _UNKNOWN_EDGES)[0]
        for part in (0, 1)
    )
    counts = zip((known + new).tolist(), new.tolist(), strict=True)
    rows = ((*edges, *each) for edges, each in zip(pairwise(_UNKNOWN_EDGES), counts, strict=True))
    return tuple(rows) if scored else ()


def _consecutive(runs: Sequence[Sequence[_Answer]], k: int) -> tuple[float, tuple[float, float]]:
    """Return the share of right answers over runs of k grasps, and its interval; NaN without."""
    fused = [
        (fusion.fuse([p for p, _ in run[i : i + k]]), run[0][1])
        for run in runs
        for i in range(0, len(run) - k + 1, k)
    ]
    if not fused:
        return float("nan"), (float("nan"), float("nan"))
    share, shares = _shares(fused)
    return share, shares["interval"]
