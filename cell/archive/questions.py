"""Questions to an archive: confused objects, drifting cells, ageing pads, friction, few grasps.

Each cell and day is one piece of work and gives a few sums, so the answers of any archive fit into
memory. A value of a grasp also depends on its object. Day effects of a cell are the rest after the
object effects.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import date
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit, xlogy

from cell.archive.selection import EVERYTHING, Selection
from cell.archive.store import Archive, Partition, nothing_selected
from recognition.evaluation.evaluation import Mapper, one_by_one
from recognition.evaluation.metrics import wilson_interval
from recognition.recognizer import UNKNOWN
from recognition.statistics.day_effects import day_effects

_COLUMNS = (
    "label", "taught", "answer", "of_part", "part_grasps", "zero", "closing_current_a",
    "hold_current_a", "touch_aperture_m", "pad_load",
)  # fmt: skip
LEAST_DAYS = 3
"""Fewest days of a cell for a trend."""
_LEAST_EVIDENCE = 5.0
"""Logarithm of the likelihood ratio above which a confusion has a first day."""
_FEW_GRASPS, _ENOUGH_RIGHT = 10, 0.95
"""Fewest grasps of an object, and the required share of right names."""


def _log(value: float) -> float:
    return float(np.log(value)) if value > 0.0 else float("nan")


def _response(row: Mapping[str, Any], pad: int) -> float:
    """Return the logarithm of a pad's load for each A of current without friction."""
    loads, hold = row["pad_load"] or (), row["hold_current_a"]
    if len(loads) <= pad or hold is None or row["closing_current_a"] is None:
        return float("nan")
    return _log(loads[pad]) - _log(hold - row["closing_current_a"])


def _apart(row: Mapping[str, Any]) -> float:
    loads: list[float] = row["pad_load"] or []
    return _log(loads[0]) - _log(loads[1]) if len(loads) == 2 else float("nan")


@dataclass(frozen=True, slots=True, kw_only=True)
class Signal:
    """A value of each grasp whose trend answers a question."""

    name: str
    title: str
    unit: str
    question: str
    """Key of the question that the signal answers."""
    value: Callable[[Mapping[str, Any]], float]
    """Value of a row; NaN where unknown."""
    least: float
    """Smallest change from the first day to the last that counts."""
    signs: tuple[int, ...] = (-1, 1)
    """Directions of change that count."""


_LOG = "log"
"""Unit of logarithms of ratios; pages show their changes in per cent."""
SIGNALS: tuple[Signal, ...] = (
    Signal(
        name="opening", title="Opening at the first touch", unit="mm", question="drift", least=0.5,
        value=lambda row: 1e3 * (row["touch_aperture_m"] or np.nan),
    ),
    Signal(
        name="zero", title="Self-zero of the opening", unit="mm", question="drift", least=0.3,
        value=lambda row: np.nan if row["zero"] is None else 1e3 * row["zero"]["opening_m"],
    ),
    Signal(
        name="pad 0", title="Response of pad 0 for each A", unit=_LOG, question="ageing",
        least=0.1, signs=(-1,), value=lambda row: _response(row, 0),
    ),
    Signal(
        name="pad 1", title="Response of pad 1 for each A", unit=_LOG, question="ageing",
        least=0.1, signs=(-1,), value=lambda row: _response(row, 1),
    ),
    Signal(
        name="pad 0 against pad 1", title="Load of pad 0 over that of pad 1", unit=_LOG,
        question="ageing", least=0.1, value=_apart,
    ),
    Signal(
        name="friction", title="Current of the closing, empty fingers", unit=_LOG,
        question="friction", least=0.1, signs=(1,),
        value=lambda row: _log(row["closing_current_a"] or 0.0),
    ),
)  # fmt: skip
"""All signals; a change of a logarithm by 0.1 is 10 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DaySums:
    """Sums over the grasps of a cell on a day."""

    cell: str
    day: str
    n_grasps: int
    answers: Mapping[tuple[str, str], int]
    """Number of parts by true label and answer."""
    objects: Mapping[str, tuple[int, int]]
    """Grasps of each label, and grasps of all its identifications."""
    values: Mapping[str, NDArray[np.float64]]
    """(n_signals, 3) float64 of each label: number, sum and sum of squares."""


def day_sums(target: str, selection: Selection, partition: Partition) -> DaySums:
    """Return the sums of one cell and day."""
    answers, n_grasps = Counter[tuple[str, str]](), 0
    objects: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0])
    values: defaultdict[str, NDArray[np.float64]] = defaultdict(lambda: np.zeros((len(SIGNALS), 3)))
    for _, batch in Archive(target).batches(_COLUMNS, selection, [partition]):
        for row in batch.to_pylist():
            n_grasps += 1
            label = row["label"]
            found = np.array([signal.value(row) for signal in SIGNALS])
            known = np.isfinite(found)
            found = np.where(known, found, 0.0)
            values[label] += np.stack([known, found, found**2], axis=1)
            objects[label][0] += 1
            if row["of_part"] == 0:
                answers[label, row["answer"]] += 1
                objects[label][1] += row["part_grasps"]
    return DaySums(
        cell=partition.cell,
        day=partition.day,
        n_grasps=n_grasps,
        answers=dict(answers),
        objects={label: (n, k) for label, (n, k) in objects.items()},
        values=dict(values),
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class Trend:
    """A signal of a cell over its days."""

    cell: str
    signal: str
    unit: str
    question: str
    days: tuple[str, ...]
    effect: tuple[float, ...]
    """Value of each day less the mean of all."""
    change: float
    interval: tuple[float, float]
    """Change from the first day to the last by a straight line, and its 95 % interval."""
    found: bool
    """Whether the question is answered with yes: certain, large enough, in a counted direction.
    """
    since: str
    """Day from which it is off by half of the least counted change; empty where unknown."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Confusion:
    """An object that was identified as another one."""

    label: str
    answer: str
    n: int
    n_parts: int
    """Number of confusions, and number of all its identifications."""
    cells: Mapping[str, int]
    """Number of confusions on each cell."""
    first: str
    last: str
    """First and last day."""
    since: str
    """Day from which it is more frequent; empty where it is equally frequent on all days."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectNeed:
    """Recognition of one object and its need of grasps."""

    label: str
    n_grasps: int
    n_days: int
    n_cells: int
    n_parts: int
    n_right: int
    interval: tuple[float, float]
    """Identifications, right ones, and the 95 % interval of their share."""
    grasps_per_part: float
    """Mean number of grasps until an answer; NaN without one."""
    reasons: tuple[str, ...]
    """Reasons to take more grasps; empty where they suffice."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answers:
    """Answers of an archive."""

    n_grasps: int
    cells: Mapping[str, tuple[str, ...]]
    """Cells and their days."""
    confusions: tuple[Confusion, ...]
    """Most frequent first."""
    trends: tuple[Trend, ...]
    objects: tuple[ObjectNeed, ...]
    """Objects with the greatest need first."""
    parts: Mapping[tuple[str, str], int] = field(default_factory=dict)
    """Number of identifications by true label and answer."""

    def found(self, question: str) -> tuple[Trend, ...]:
        """Return the trends that answer a question with yes, the largest first."""
        those = [t for t in self.trends if t.found and t.question == question]
        return tuple(sorted(those, key=lambda trend: -abs(trend.change)))

    def as_json(self) -> dict[str, Any]:
        """Return the output of ``--json``."""
        values = asdict(self)
        values["parts"] = [
            {"label": label, "answer": answer, "n": n} for (label, answer), n in self.parts.items()
        ]
        return values | {
            "drifting_cells": sorted({t.cell for t in self.found("drift")}),
            "ageing_pads": [(t.cell, t.signal) for t in self.found("ageing")],
            "growing_friction": [t.cell for t in self.found("friction")],
            "need_grasps": [one.label for one in self.objects if one.reasons],
        }


def ask(
    target: str,
    selection: Selection = EVERYTHING,
    *,
    mapper: Mapper = one_by_one,
    progress: Callable[[str, int, int], None] = lambda *_: None,
) -> Answers:
    """Return the answers of the selected part of an archive; the mapper works day by day.

    Raises ArchiveError where no grasp is selected.
    """
    partitions = list(Archive(target).partitions(selection))
    sums = []
    for one in mapper(partial(day_sums, target, selection), partitions):
        sums.append(one)
        progress("report", len(sums), len(partitions))
    sums = [one for one in sums if one.n_grasps]
    if not sums:
        raise nothing_selected(target)
    of_cell: defaultdict[str, list[DaySums]] = defaultdict(list)
    parts = Counter[tuple[str, str]]()
    for one in sums:
        of_cell[one.cell].append(one)
        parts.update(one.answers)
    return Answers(
        n_grasps=sum(one.n_grasps for one in sums),
        cells={cell: tuple(one.day for one in days) for cell, days in of_cell.items()},
        confusions=tuple(_confusions(sums, parts)),
        trends=tuple(trend for days in of_cell.values() for trend in _trends(days)),
        objects=tuple(_needs(sums)),
        parts=dict(parts),
    )


def _trends(days: Sequence[DaySums]) -> Iterable[Trend]:
    """Yield the trend of each signal with enough days of a cell."""
    labels = sorted({label for one in days for label in one.values})
    nothing = np.zeros((len(SIGNALS), 3))
    every = np.array([[one.values.get(label, nothing) for label in labels] for one in days])
    ordinal = np.array([date.fromisoformat(one.day).toordinal() for one in days], dtype=np.float64)
    for number, signal in enumerate(SIGNALS):
        n, total = every[:, :, number, 0], every[:, :, number, 1]
        shared = n * (np.count_nonzero(n, axis=0) > 1)  # an object of one day shows no change
        rows = shared.sum(axis=1) > 0
        if np.count_nonzero(rows) < LEAST_DAYS:
            continue
        mean = np.divide(total, n, out=np.zeros_like(total), where=n > 0)
        effect = day_effects(mean[rows], shared[rows])
        x = ordinal[rows] - ordinal[rows].mean()
        slope = float(x @ effect / (x @ x))
        rest = effect - effect.mean() - slope * x
        freedom = len(x) - 2
        sd = float(np.sqrt(rest @ rest / freedom / (x @ x)))
        span = float(np.ptp(x))
        change, reach = slope * span, float(stdtrit(freedom, 0.975)) * sd * span
        low, high = change - reach, change + reach
        found = (
            abs(change) >= signal.least
            and low * high > 0.0
            and int(np.sign(change)) in signal.signs
        )
        shown = [one.day for one, taken in zip(days, rows, strict=True) if taken]
        moved = np.sign(change) * (effect - effect[0]) >= 0.5 * signal.least
        yield Trend(
            cell=days[0].cell,
            signal=signal.name,
            unit=signal.unit,
            question=signal.question,
            days=tuple(shown),
            effect=tuple(effect.tolist()),
            change=change,
            interval=(low, high),
            found=found,
            since=shown[_last_run(moved)] if found and moved[-1] else "",
        )


def _last_run(holds: NDArray[np.bool_]) -> int:
    """Return the start of the run of true values at the end."""
    others = np.flatnonzero(~holds)
    return int(others[-1]) + 1 if len(others) else 0


def _confusions(
    sums: Sequence[DaySums], parts: Mapping[tuple[str, str], int]
) -> Iterable[Confusion]:
    days = sorted({one.day for one in sums})
    for (label, answer), n in sorted(parts.items(), key=lambda item: -item[1]):
        if not label or answer in (label, UNKNOWN):
            continue
        k_of, n_of = Counter[str](), Counter[str]()
        cells = Counter[str]()
        for one in sums:
            found = one.answers.get((label, answer), 0)
            k_of[one.day] += found
            n_of[one.day] += sum(k for (was, _), k in one.answers.items() if was == label)
            cells[one.cell] += found
        met = [day for day in days if k_of[day]]
        yield Confusion(
            label=label,
            answer=answer,
            n=n,
            n_parts=sum(n_of.values()),
            cells={cell: k for cell, k in cells.items() if k},
            first=met[0],
            last=met[-1],
            since=_since(days, k_of, n_of),
        )


def _since(days: Sequence[str], k_of: Mapping[str, int], n_of: Mapping[str, int]) -> str:
    """Return the day on which a share rises, by the likelihood of two shares against one."""
    k = np.cumsum([k_of[day] for day in days], dtype=np.float64)
    n = np.cumsum([n_of[day] for day in days], dtype=np.float64)
    before_k, before_n, after_k, after_n = k[:-1], n[:-1], k[-1] - k[:-1], n[-1] - n[:-1]
    gain = _likelihood(before_k, before_n) + _likelihood(after_k, after_n) - _likelihood(k, n)[-1]
    rises = after_k * before_n > before_k * after_n
    gain = np.where(rises & (before_n > 0), gain, -np.inf)
    if not len(gain) or gain.max() < _LEAST_EVIDENCE:
        return ""
    return days[int(gain.argmax()) + 1]


def _likelihood(k: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the largest log likelihood of k of n."""
    share = k / np.maximum(n, 1.0)
    return np.asarray(xlogy(k, share) + xlogy(n - k, 1.0 - share), dtype=np.float64)


def _needs(sums: Sequence[DaySums]) -> list[ObjectNeed]:
    found = []
    for label in sorted({label for one in sums for label in one.objects} - {""}):
        here = [one for one in sums if label in one.objects]
        n_grasps = sum(one.objects[label][0] for one in here)
        n_asked = sum(one.objects[label][1] for one in here)
        n_parts = sum(k for one in here for (was, _), k in one.answers.items() if was == label)
        n_right = sum(one.answers.get((label, label), 0) for one in here)
        low, high = wilson_interval(n_right, n_parts)
        reasons = []
        if n_grasps < _FEW_GRASPS:
            reasons.append(f"{n_grasps} grasps, {_FEW_GRASPS} are needed")
        if high < _ENOUGH_RIGHT:
            reasons.append(f"named rightly {n_right} of {n_parts} times")
        found.append(
            ObjectNeed(
                label=label,
                n_grasps=n_grasps,
                n_days=len({one.day for one in here}),
                n_cells=len({one.cell for one in here}),
                n_parts=n_parts,
                n_right=n_right,
                interval=(low, high),
                grasps_per_part=n_asked / n_parts if n_parts else float("nan"),
                reasons=tuple(reasons),
            )
        )
    return sorted(found, key=lambda one: (not one.reasons, one.interval[1], one.n_grasps))
