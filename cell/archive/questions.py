"""Questions to an archive: confused objects, drifting cells, ageing pads, friction, few grasps.

The archive is read once, without its frames. A value of a grasp also depends on its object: day
effects of a cell are the rest after the object effects.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from scipy.special import stdtrit

from cell.archive.selection import EVERYTHING, Selection
from cell.archive.store import Archive
from cell.errors import ArchiveError
from recognition.drift.drift import day_effects
from recognition.evaluation.evaluation import wilson_interval
from recognition.recognizer import UNKNOWN

_COLUMNS = (
    "cell", "day", "label", "answer", "of_part", "part_grasps", "probabilities", "zero",
    "closing_current_a", "hold_current_a", "touch_aperture_m", "pad_load",
)  # fmt: skip
LEAST_DAYS = 3
"""Fewest days of a cell for a trend."""
_FEW_GRASPS, _ENOUGH_RIGHT = 10, 0.95
"""Fewest grasps of an object, and the required share of right names."""

Row = Mapping[str, Any]


class Signal(NamedTuple):
    """A value of each grasp whose trend answers a question."""

    title: str
    unit: str
    question: str
    """Key of the question that the signal answers."""
    least: float
    """Smallest change from the first day to the last that counts."""
    signs: tuple[int, ...] = (-1, 1)
    """Directions of change that count."""


_LOG = "log"
"""Unit of logarithms of ratios; pages show their changes in per cent. 0.1 is 10 %."""
SIGNALS: Mapping[str, Signal] = {
    "opening": Signal("Opening at the first touch", "mm", "drift", 0.5),
    "zero": Signal("Self-zero of the opening", "mm", "drift", 0.3),
    "pad 0": Signal("Response of pad 0 for each A", _LOG, "ageing", 0.1, (-1,)),
    "pad 1": Signal("Response of pad 1 for each A", _LOG, "ageing", 0.1, (-1,)),
    "pad 0 against pad 1": Signal("Load of pad 0 over that of pad 1", _LOG, "ageing", 0.1),
    "friction": Signal("Current of the closing, empty fingers", _LOG, "friction", 0.1, (1,)),
}
"""All signals by their names."""


def _signals(rows: pa.Table) -> dict[str, NDArray[np.float64]]:
    """Return the signals of all rows, (n_rows,) float64 each; NaN where unknown."""

    def log(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.log(np.where(values > 0.0, values, np.nan))

    closing_a, hold_a = (rows[f"{name}_current_a"].to_numpy() for name in ("closing", "hold"))
    first, second = np.array(
        [(*(loads or ()), np.nan, np.nan)[:2] for loads in rows["pad_load"].to_pylist()]
    ).T
    current = log(hold_a - closing_a)  # without friction
    return {
        "opening": 1e3 * rows["touch_aperture_m"].to_numpy(),
        "zero": 1e3 * pc.struct_field(rows["zero"], "opening_m").to_numpy(),
        "pad 0": log(first) - current,
        "pad 1": log(second) - current,
        "pad 0 against pad 1": log(first) - log(second),
        "friction": log(closing_a),
    }


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
    counts: bool
    """Whether the question is answered with yes: certain, large enough, in a counted direction.
    """


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

    def counted(self, question: str) -> tuple[Trend, ...]:
        """Return the trends that answer a question with yes, the largest first."""
        those = [t for t in self.trends if t.counts and t.question == question]
        return tuple(sorted(those, key=lambda trend: -abs(trend.change)))

    def as_json(self) -> dict[str, Any]:
        """Return the output of ``--json``."""
        parts = [
            {"label": label, "answer": answer, "n": n} for (label, answer), n in self.parts.items()
        ]
        return asdict(replace(self, parts={})) | {"parts": parts}


def ask(target: str, selection: Selection = EVERYTHING) -> Answers:
    """Return the answers of the selected part of an archive.

    Raises ArchiveError where no grasp is selected.
    """
    rows = Archive(target).table(_COLUMNS, selection)
    if not rows.num_rows:
        raise ArchiveError(
            f"no grasp of {target} is selected: look at its folders for cells and days"
        )
    keys = {name: rows[name] for name in ("cell", "day", "label")}
    signals = {name: pa.array(values, from_pandas=True) for name, values in _signals(rows).items()}
    means = _grouped(
        pa.table(keys | signals),
        ["cell", "day", "label"],
        [(n, how) for n in SIGNALS for how in ("count", "mean")],
    )
    named = rows.filter(pc.field("of_part") == 0)
    parts = _grouped(
        named.append_column("truth", pa.array(_truths(named), pa.string())),
        ["cell", "day", "label", "truth", "answer"],
        [([], "count_all"), ("part_grasps", "sum")],
    )
    of_cell: defaultdict[str, list[Row]] = defaultdict(list)
    for row in means:
        of_cell[row["cell"]].append(row)
    asked = Counter[tuple[str, str]]()
    for row in parts:
        asked[row["truth"], row["answer"]] += row["count_all"]
    return Answers(
        n_grasps=rows.num_rows,
        cells={
            cell: tuple(dict.fromkeys(row["day"] for row in some)) for cell, some in of_cell.items()
        },
        confusions=tuple(_confusions(parts)),
        trends=tuple(trend for cell, some in of_cell.items() for trend in _trends(cell, some)),
        objects=tuple(_needs(rows, parts)),
        parts=dict(asked),
    )


def _truths(parts: pa.Table) -> list[str]:
    """Return the right answer to each identification: UNKNOWN where its object was never taught."""
    columns = (parts[name].to_pylist() for name in ("label", "probabilities"))
    return [
        label if not label or not taught or label in dict(taught) else UNKNOWN
        for label, taught in zip(*columns, strict=True)
    ]


def _grouped(rows: pa.Table, keys: list[str], values: list[tuple[Any, str]]) -> list[Row]:
    """Return the values of each group, sorted by the keys."""
    groups = rows.group_by(keys, use_threads=False).aggregate(values)
    return list(groups.sort_by([(key, "ascending") for key in keys]).to_pylist())


def _trends(cell: str, rows: Sequence[Row]) -> Iterable[Trend]:
    """Yield the trend of each signal with enough days of a cell."""
    rows = [row for row in rows if row["day"] > "2000"]  # the clock was not set before
    days, labels = (sorted({row[name] for row in rows}) for name in ("day", "label"))
    places = tuple(
        np.array([(days.index(row["day"]), labels.index(row["label"])) for row in rows]).T
    )
    ordinal = np.array([date.fromisoformat(day).toordinal() for day in days], dtype=np.float64)
    for name, signal in SIGNALS.items():
        n, mean = np.zeros((2, len(days), len(labels)))
        n[places] = [row[f"{name}_count"] for row in rows]
        mean[places] = [row[f"{name}_mean"] or 0.0 for row in rows]
        shared = n * (np.count_nonzero(n, axis=0) > 1)  # an object of one day shows no change
        taken = shared.sum(axis=1) > 0
        if np.count_nonzero(taken) < LEAST_DAYS:
            continue
        effect = day_effects(mean[taken], shared[taken])
        x = ordinal[taken] - ordinal[taken].mean()
        (slope, _), covariance = np.polyfit(x, effect, 1, cov=True)
        change, sd = np.ptp(x) * np.array([slope, np.sqrt(covariance[0, 0])])
        low, high = change + sd * stdtrit(len(x) - 2, [0.025, 0.975])
        counts = (
            abs(change) >= signal.least
            and low * high > 0.0
            and int(np.sign(change)) in signal.signs
        )
        days_taken = [day for day, is_taken in zip(days, taken, strict=True) if is_taken]
        yield Trend(
            cell=cell,
            signal=name,
            unit=signal.unit,
            question=signal.question,
            days=tuple(days_taken),
            effect=tuple(effect.tolist()),
            change=float(change),
            interval=(float(low), float(high)),
            counts=bool(counts),
        )


def _confusions(parts: Sequence[Row]) -> Iterable[Confusion]:
    asked = Counter[tuple[str, str]]()
    for row in parts:
        asked[row["label"], row["answer"]] += row["count_all"]
    for (label, answer), n in sorted(asked.items(), key=lambda item: -item[1]):
        if not label or answer in (label, UNKNOWN):
            continue
        confused = [row for row in parts if (row["label"], row["answer"]) == (label, answer)]
        cells, days = Counter[str](), sorted(row["day"] for row in confused)
        for row in confused:
            cells[row["cell"]] += row["count_all"]
        yield Confusion(
            label=label,
            answer=answer,
            n=n,
            n_parts=sum(count for (held, _), count in asked.items() if held == label),
            cells=dict(cells),
            first=days[0],
            last=days[-1],
        )


def _needs(rows: pa.Table, parts: Sequence[Row]) -> list[ObjectNeed]:
    needs = []
    counted = [([], "count_all"), ("day", "count_distinct"), ("cell", "count_distinct")]
    for row in _grouped(rows, ["label"], counted):
        if not (label := row["label"]):
            continue
        here = [part for part in parts if part["label"] == label]
        n_parts = sum(part["count_all"] for part in here)
        n_right = sum(part["count_all"] for part in here if part["answer"] == part["truth"])
        grasps = sum(part["part_grasps_sum"] for part in here)
        low, high = wilson_interval(n_right, n_parts)
        reasons = []
        if row["count_all"] < _FEW_GRASPS:
            reasons.append(f"{row['count_all']} grasps, {_FEW_GRASPS} are needed")
        if high < _ENOUGH_RIGHT:
            reasons.append(f"named rightly {n_right} of {n_parts} times")
        needs.append(
            ObjectNeed(
                label=label,
                n_grasps=row["count_all"],
                n_days=row["day_count_distinct"],
                n_cells=row["cell_count_distinct"],
                n_parts=n_parts,
                n_right=n_right,
                interval=(low, high),
                grasps_per_part=grasps / n_parts if n_parts else float("nan"),
                reasons=tuple(reasons),
            )
        )
    return sorted(needs, key=lambda need: (not need.reasons, need.interval[1], need.n_grasps))
