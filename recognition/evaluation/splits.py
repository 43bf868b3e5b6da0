"""Splits of grasps into those that teach and those that test."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from recognition.grasp import Grasp, by_label, series_of

_DAY_MS = 24 * 3_600_000
"""A day in ms."""

TrainTest = tuple[tuple[Grasp, ...], tuple[Grasp, ...]]
"""Grasps that teach, and grasps that test."""


def chronological_split(grasps: Sequence[Grasp], fraction: float) -> TrainTest:
    """Return (train, test): of each label the first fraction in time teaches, the rest tests.

    Each part has a grasp of each label with two or more. Raises ValueError where a grasp has no
    label.
    """
    train: list[Grasp] = []
    test: list[Grasp] = []
    for members in by_label(grasps).values():
        n = len(members)
        cut = min(max(round(fraction * n), 1), max(n - 1, 1))
        train += members[:cut]
        test += members[cut:]
    return tuple(train), tuple(test)


def series_names(grasps: Sequence[Grasp]) -> list[str]:
    """Return for each grasp a name of its object and series; ValueError where one has no label."""
    names = {
        id(grasp): f"{label} {number:06}"
        for label, members in by_label(grasps).items()
        for number, series in enumerate(series_of(members))
        for grasp in series
    }
    return [names[id(grasp)] for grasp in grasps]


def left_out_parts(
    grasps: Sequence[Grasp], groups: Sequence[str], *, least: int = 3
) -> list[TrainTest]:
    """Return a part for each group, as a day, cell or series: it tests, and all others teach.

    Objects with fewer than ``least`` grasps left to teach neither teach nor test. Raises ValueError
    where no part remains.
    """
    parts = []
    for out in sorted(set(groups)):
        taught = [g for g, group in zip(grasps, groups, strict=True) if group != out]
        n_of = Counter(g.label for g in taught)
        labels = {label for label, n in n_of.items() if n >= least}
        test = [g for g, group in zip(grasps, groups, strict=True) if group == out]
        part = tuple(tuple(g for g in some if g.label in labels) for some in (taught, test))
        if all(part):
            parts.append((part[0], part[1]))
    if not parts:
        raise ValueError(
            f"no object has {least} grasps in each of two of the {len(set(groups))} days, cells or "
            "series: none can be left out. Add grasps of the same objects on another day, or name "
            "the series"
        )
    return parts


def parse_split(text: str) -> float:
    """Return the fraction of a text as ``chronological:0.6``, for `chronological_split`.

    Raises ValueError, naming the accepted text, for any other one.
    """
    name, _, number = text.partition(":")
    try:
        fraction = float(number)
    except ValueError:
        fraction = float("nan")
    if name != "chronological" or not 0.0 < fraction < 1.0:
        raise ValueError(
            f"split {text!r} is not understood: give chronological:FRACTION, a fraction between 0 "
            "and 1, for example chronological:0.6, or series, days or cells"
        )
    return fraction


def a_day_later(grasp: Grasp) -> Grasp:
    """Return a copy of the grasp with a date one day later: sensors drift from day to day."""
    return replace(grasp, start_ms=grasp.start_ms + _DAY_MS)
