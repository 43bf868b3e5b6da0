"""Splits of grasps into those that teach and those that test."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from recognition.grasp import Grasp, by_label, series_of

_DAY_MS = 24 * 3_600_000
"""A day in ms."""

TrainTest = tuple[tuple[Grasp, ...], tuple[Grasp, ...]]
"""Grasps that teach, and grasps that test."""

Split = Callable[[Sequence[Grasp]], TrainTest]


def chronological_split(grasps: Sequence[Grasp], fraction: float) -> TrainTest:
    """Return (train, test): of each label the first fraction in time teaches, the rest tests.

    Raises ValueError where the fraction is not between 0 and 1 or a grasp has no label.
    """
    train: list[Grasp] = []
    test: list[Grasp] = []
    for members in by_label(grasps).values():
        cut = _cut(len(members), fraction)
        train += members[:cut]
        test += members[cut:]
    return tuple(train), tuple(test)


def shuffled_split(grasps: Sequence[Grasp], fraction: float, seed: int) -> TrainTest:
    """Return (train, test): of each label a random fraction teaches, the rest tests.

    Neighbours in time look alike, so the accuracy is too high; only for published comparisons.
    Raises ValueError where the fraction is not between 0 and 1 or a grasp has no label.
    """
    rng = np.random.default_rng(seed)
    train: list[Grasp] = []
    test: list[Grasp] = []
    for members in by_label(grasps).values():
        cut = _cut(len(members), fraction)
        order = rng.permutation(len(members))
        train += [members[i] for i in sorted(order[:cut])]
        test += [members[i] for i in sorted(order[cut:])]
    return tuple(train), tuple(test)


def series_parts(grasps: Sequence[Grasp]) -> list[TrainTest]:
    """Return a part for each series of objects with several: the series tests, all else teaches.

    The result is the loss on another day for an object that was taught on several. Raises
    ValueError where no object has several series, or a grasp has no label.
    """
    series = {label: series_of(members) for label, members in by_label(grasps).items()}
    held_out = [one for found in series.values() if len(found) > 1 for one in found]
    if not held_out:
        raise ValueError(
            f"each of the {len(series)} objects was grasped in one series, without a pause of an "
            "hour: none can be left out; add a data set of another day, or name the series"
        )
    return [
        (tuple(g for g in grasps if not any(g is other for other in one)), tuple(one))
        for one in held_out
    ]


def left_out_parts(
    grasps: Sequence[Grasp], groups: Sequence[str], *, least: int = 3
) -> list[TrainTest]:
    """Return a part for each group, for example a day or a cell: it tests, and all others teach.

    Objects with fewer than ``least`` grasps left to teach neither teach nor test. Raises ValueError
    where no part remains.
    """
    parts = []
    for out in sorted(set(groups)):
        taught = [g for g, group in zip(grasps, groups, strict=True) if group != out]
        n_of = Counter(g.label for g in taught)
        known = {label for label, n in n_of.items() if n >= least}
        test = [g for g, group in zip(grasps, groups, strict=True) if group == out]
        part = tuple(tuple(g for g in some if g.label in known) for some in (taught, test))
        if all(part):
            parts.append((part[0], part[1]))
    if not parts:
        raise ValueError(
            f"no object has {least} grasps outside of one group, of {len(set(groups))} such as a "
            "day or a cell: none can be left out; add grasps of the same objects of another group"
        )
    return parts


def parse_split(text: str, *, seed: int = 0) -> Split:
    """Return the split that a text names: ``chronological:0.6`` or ``shuffled:0.8``.

    Raises ValueError, naming the accepted texts, for any other text.
    """
    name, _, number = text.partition(":")
    try:
        fraction = float(number)
    except ValueError:
        fraction = float("nan")
    if name not in ("chronological", "shuffled") or not 0.0 < fraction < 1.0:
        raise ValueError(
            f"split {text!r} is not understood: give chronological:FRACTION or shuffled:FRACTION "
            "with a fraction between 0 and 1, for example chronological:0.6"
        )
    if name == "chronological":
        return lambda grasps: chronological_split(grasps, fraction)
    return lambda grasps: shuffled_split(grasps, fraction, seed)


def a_day_later(grasp: Grasp) -> Grasp:
    """Return a copy of the grasp with a date one day later: sensors drift from day to day."""
    return replace(grasp, start_ms=grasp.start_ms + _DAY_MS)


def _cut(n: int, fraction: float) -> int:
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"fraction is {fraction}, must be above 0 and below 1")
    return min(max(round(fraction * n), 1), max(n - 1, 1))
