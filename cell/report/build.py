"""The parts of a report, from the values of a run."""

from collections.abc import Mapping, Sequence

import numpy as np

from cell.report.data import (
    ConfusionTable,
    HealthGroup,
    HealthRow,
    HealthState,
    Window,
)
from cell.report.paper_table import TABLE_1, TABLE_1_LABELS, TABLE_1_TRIALS
from recognition.quadric.thresholds import LevelBands
from recognition.recognizer import UNKNOWN, Posterior

BASELINE = "level_check"
"""The paper's classifier: the likeliest object by one grasp, never UNKNOWN, as in its Table 1."""


def score(
    name: str, truths: Sequence[str], answers: Sequence[str], labels: Sequence[str]
) -> ConfusionTable:
    """Count answers against the truth; answers that are not a label count as UNKNOWN."""
    columns = (*labels, UNKNOWN)
    counts = np.zeros((len(labels), len(columns)), dtype=np.int64)
    for truth, answer in zip(truths, answers, strict=True):
        if truth in labels:
            place = columns.index(answer) if answer in columns else len(labels)
            counts[labels.index(truth), place] += 1
    return ConfusionTable(name=name, labels=tuple(labels), columns=columns, counts=counts)


def score_tables(
    trials: Sequence[tuple[str, str, Mapping[str, Posterior]]], labels: Sequence[str], default: str
) -> dict[str, ConfusionTable]:
    """Return the tables of identifications, by recogniser; empty without trials.

    Parameters
    ----------
    trials
        Held object, answer, and the answer of each recogniser to the first grasp only.
    labels
        The objects, in the order of the rows.
    default
        Name of the recogniser that answered.
    """
    if not trials:
        return {}
    truths, answers, first = zip(*trials, strict=True)
    scores = {default: score("This cell, all grasps", truths, answers, labels)}
    for name in first[0]:
        posteriors = [one[name] for one in first]
        named = [p.best if name == BASELINE else p.name for p in posteriors]
        key = f"{name}_one_grasp" if name == default else name
        whose = "This cell" if name == default else "The paper's method"
        scores[key] = score(f"{whose}, first grasp only", truths, named, labels)
    return scores


def level_windows(levels: LevelBands, labels: Sequence[str]) -> tuple[Window, ...]:
    """Name the windows between the levels A, B, C, ... from the lowest upwards."""
    return tuple(
        Window(
            name=chr(ord("A") + i) if i < 26 else str(i + 1),
            below=labels[below],
            above=labels[above],
            low=float(levels.high[below]),
            high=float(levels.low[above]),
            threshold=float(levels.threshold[i]),
        )
        for i, (below, above) in enumerate(zip(levels.order[:-1], levels.order[1:], strict=True))
    )


def paper_table() -> ConfusionTable:
    """Return Table 1 of the paper: ten trials of each of five objects."""
    return ConfusionTable(
        name="Paper, Table 1",
        labels=TABLE_1_LABELS,
        columns=TABLE_1_LABELS,
        counts=np.array(TABLE_1) * TABLE_1_TRIALS // 100,
        caption=f"Petchartee et al. 2008, {TABLE_1_TRIALS} trials of each object",
    )


def _count(name: str, value: int, *, bad: bool = False, note: str = "") -> HealthRow:
    state: HealthState = "ok" if value == 0 else "bad" if bad else "warn"
    return HealthRow(name=name, value=f"{value:,}", state=state, note=note)


def source_health(counts: Mapping[str, int]) -> HealthGroup:
    """Return the counts of tactile frames and of their line."""
    complete, lost = counts["complete"], counts["lost"]
    share = lost / max(1, complete + lost)
    return HealthGroup(
        title="Tactile frames",
        rows=(
            HealthRow(
                name="whole frames", value=f"{complete:,}", state="ok" if complete else "bad"
            ),
            _count("lost", lost, bad=share > 0.01, note=f"{share:.2%} of all"),
            _count("torn", counts["torn"], note="incomplete, dropped"),
            _count("duplicate", counts["duplicate"], note="messages, dropped"),
            _count("out of order", counts["reordered"], note="messages"),
            _count("stale", counts["stale"], note="older than the last, dropped"),
            _count("short", counts["short"], note="messages, dropped"),
            _count("corrupt", counts["corrupt"], bad=True, note="refused by checksum or phase"),
            _count("late requests", counts["late_requests"], note=f"of {counts['requests']:,}"),
            _count("malformed", counts["malformed"], note="other messages, dropped"),
            _count("error frames", counts["error_frames"], bad=counts["error_frames"] > 10),
        ),
    )


def servo_health(counts: Mapping[str, int]) -> HealthGroup:
    """Return the counts of transactions on the servo bus."""
    total = counts["transactions"]
    return HealthGroup(
        title="Servo bus",
        rows=(
            HealthRow(name="transactions", value=f"{total:,}", state="ok" if total else "bad"),
            _count("retries", counts["retries"], bad=counts["retries"] * 100 > total),
            _count("time-outs", counts["timeouts"], bad=counts["timeouts"] * 100 > total),
            _count("corrupt", counts["corrupt"], note="answers, never used"),
            _count("late", counts["late"], note="answers to an earlier request, dropped"),
        ),
    )


def loop_health(values: Mapping[str, float], period_s: float) -> HealthGroup:
    """Return the timing of the force loop from `cell.control.journal.loop_values`.

    ``period_s`` is the length of a period in s.
    """
    total, late, worst_s = (int(values["cycles"]), int(values["late"]), values["worst_lateness_s"])

    def ms(name: str) -> str:
        return f"{values[name] * 1e3:.2f}"

    return HealthGroup(
        title="Force loop",
        rows=(
            HealthRow(name="periods", value=f"{total:,}", note=f"of {period_s * 1e3:.1f} ms"),
            _count("late", late, bad=late > 0.01 * total, note="by more than half a period"),
            _count("overruns", int(values["overruns"]), note="work not done when the next was due"),
            _count(
                "without feedback",
                int(values["missed_reads"]),
                note="periods without a write to the servos",
            ),
            HealthRow(
                name="worst lateness",
                value=f"{ms('worst_lateness_s')} ms",
                state=_punctuality(worst_s, period_s),
                note=f"p50 {ms('lateness_p50_s')}, p99 {ms('lateness_p99_s')}, "
                f"p99.9 {ms('lateness_p999_s')} ms",
            ),
            HealthRow(
                name="reading the servos",
                value=f"{ms('transaction_p50_s')} ms",
                note=f"median; p99 {ms('transaction_p99_s')} ms",
            ),
            HealthRow(name="oldest force used", value=f"{values['sensor_age_max_s'] * 1e3:.0f} ms"),
        ),
    )


def _punctuality(lateness_s: float, period_s: float) -> HealthState:
    if lateness_s < 0.5 * period_s:
        return "ok"
    return "warn" if lateness_s < 2 * period_s else "bad"
