"""The parts of a report, made from the values of a run."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from gripper.dynamixel.transactions import BusStatistics
    from gripper.force.timing import LoopStatistics
    from tactile.source import SourceStatistics


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


def source_health(statistics: "SourceStatistics") -> HealthGroup:
    """Return the counts of tactile frames, and of the line that they come over."""
    frames = statistics.frames
    share = frames.lost / max(1, frames.complete + frames.lost)
    whole: HealthState = "ok" if frames.complete else "bad"
    return HealthGroup(
        title="Tactile frames",
        rows=(
            HealthRow(name="whole frames", value=f"{frames.complete:,}", state=whole),
            _count("lost", frames.lost, bad=share > 0.01, note=f"{share:.2%} of all"),
            _count("torn", frames.torn, note="begun and given up"),
            _count("duplicate", frames.duplicate, note="messages, dropped"),
            _count("out of order", frames.reordered, note="messages"),
            _count("stale", frames.stale, note="older than the last, dropped"),
            _count("short", frames.short, note="messages, dropped"),
            _count("corrupt", frames.corrupt, bad=True, note="refused by checksum or phase"),
            _count("late requests", statistics.late_requests, note=f"of {statistics.requests:,}"),
            _count("malformed", statistics.malformed, note="other messages, dropped"),
            _count("error frames", statistics.error_frames, bad=statistics.error_frames > 10),
        ),
    )


def servo_health(statistics: "BusStatistics") -> HealthGroup:
    """Return the counts of transactions on the servo bus."""
    total = statistics.transactions
    return HealthGroup(
        title="Servo bus",
        rows=(
            HealthRow(name="transactions", value=f"{total:,}", state="ok" if total else "bad"),
            _count("retries", statistics.retries, bad=statistics.retries * 100 > total),
            _count("time-outs", statistics.timeouts, bad=statistics.timeouts * 100 > total),
            _count("corrupt", statistics.corrupt, note="answers, never used"),
            _count("late", statistics.late, note="answers to an earlier request, dropped"),
        ),
    )


def loop_health(statistics: "LoopStatistics", period_s: float) -> HealthGroup:
    """Return how punctual the force loop was; ``period_s`` is the length of a period in s."""
    total, worst_s = statistics.cycles, statistics.worst_lateness_s
    share = statistics.late / max(1, total)
    late, read, age = statistics.lateness, statistics.transaction, statistics.sensor_age
    return HealthGroup(
        title="Force loop",
        rows=(
            HealthRow(name="periods", value=f"{total:,}", note=f"of {period_s * 1e3:.1f} ms"),
            _count("late", statistics.late, bad=share > 0.01, note="by more than half a period"),
            _count("overruns", statistics.overruns, note="work not done when the next was due"),
            _count("without feedback", statistics.missed_reads, note="nothing was written in them"),
            HealthRow(
                name="worst lateness",
                value=f"{worst_s * 1e3:.2f} ms",
                state=_punctuality(worst_s, period_s),
                note=f"p50 {late.p50_s * 1e3:.2f}, p99 {late.p99_s * 1e3:.2f}, "
                f"p99.9 {late.p999_s * 1e3:.2f} ms",
            ),
            HealthRow(
                name="reading the servos",
                value=f"{read.p50_s * 1e3:.2f} ms",
                note=f"median; p99 {read.p99_s * 1e3:.2f} ms",
            ),
            HealthRow(name="oldest force used", value=f"{age.max_s * 1e3:.0f} ms"),
        ),
    )


def _punctuality(lateness_s: float, period_s: float) -> HealthState:
    if lateness_s < 0.5 * period_s:
        return "ok"
    return "warn" if lateness_s < 2 * period_s else "bad"
