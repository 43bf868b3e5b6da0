"""The campaign's page: totals, the table of rows, the vocabulary of faults."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.fault_campaign.row import FaultRow, Observed
from simulator.faults import VOCABULARY

AS_REQUIRED = "as required"
"""Verdict on a row whose reaction came within its limit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What became of one row.

    Attributes
    ----------
    row
        The row.
    observed
        What was seen; None where the row itself failed.
    failure
        What broke; empty where nothing did.
    seconds
        How long it took in s.
    """

    row: FaultRow
    observed: Observed | None
    failure: str
    seconds: float

    @property
    def verdict(self) -> str:
        """``as required``, or what differs."""
        if self.observed is None:
            return f"**broken**: {self.failure}"
        complaint = complaint_of(self.row, self.observed)
        return f"**differs**: {complaint}" if complaint else AS_REQUIRED


def complaint_of(row: FaultRow, observed: Observed) -> str:
    """Return in what an observation differs from what the row asks for; empty for nothing."""
    if observed.reaction != row.reaction:
        return f"reaction {observed.reaction}, required is {row.reaction}"
    if row.limit_s is None:
        return ""
    if observed.detected_after_s is None:
        return f"never detected, the limit is {_time(row.limit_s)}"
    if observed.detected_after_s > row.limit_s:
        return f"detected after {_time(observed.detected_after_s)}, limit {_time(row.limit_s)}"
    return ""


def run_row(row: FaultRow) -> Result:
    """Run one row; what goes wrong in it is part of the result."""
    began_s = time.monotonic()
    try:
        observed, failure = row.run(), ""
    except Exception as error:
        observed, failure = None, f"{type(error).__name__}: {error}"
    return Result(row=row, observed=observed, failure=failure, seconds=time.monotonic() - began_s)


def totals(results: Sequence[Result]) -> str:
    """Return one line: how many faults, how many reactions as required."""
    good = sum(result.verdict == AS_REQUIRED for result in results)
    numbers = {result.row.row for result in results}
    return (
        f"{len(results)} faults of {len(numbers)} of the 42 rows: {good} with the required "
        f"reaction within their limit, {len(results) - good} not."
    )


def rows_table(results: Sequence[Result]) -> str:
    """Return the table of rows in Markdown."""
    lines = [
        "| row | fault | injected | reaction | limit | detected after | outcome | |",
        "|--:|---|---|---|--:|--:|---|---|",
    ]
    for result in results:
        row, observed = result.row, result.observed
        variant = f" ({row.variant})" if row.variant else ""
        lines.append(
            f"| {row.row} | {_cell(row.fault)}{variant} | `{_cell(row.injected)}` | "
            f"{row.reaction} | {_time(row.limit_s)} | "
            f"{_time(None if observed is None else observed.detected_after_s)} | "
            f"{_cell('' if observed is None else observed.outcome)} | {_cell(result.verdict)} |"
        )
    return "\n".join(lines)


def vocabulary_table() -> str:
    """Return the vocabulary of faults as a table in Markdown."""
    lines = ["| fault | kind | value | meaning |", "|---|---|---|---|"]
    for entry in VOCABULARY.values():
        value = "" if entry.value is None else entry.value.text
        moment = "; a moment, without end" if entry.moment else ""
        lines.append(
            f"| `{entry.name}` | {entry.kind.value} | {value} | {_cell(entry.meaning)}{moment} |"
        )
    return "\n".join(lines)


def _time(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    return f"{1e3 * seconds:.0f} ms" if seconds < 1.0 else f"{seconds:.2f} s"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "/").split())
