"""What became of each row of the campaign: run on several processes, and judged."""

import logging
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context

from tests.faults.campaign import FaultRow, Observed
from tests.faults.table import ROWS

AS_REQUIRED = "as required"
"""Verdict on a row whose reaction came within its limit."""


@dataclass(frozen=True, slots=True)
class Result:
    row: FaultRow
    observed: Observed | None
    """What was observed; None where the row itself failed."""
    failure: str = ""
    """What broke; empty where nothing did."""
    seconds: float = 0.0
    """How long it took in s."""

    @property
    def verdict(self) -> str:
        """``as required``, or what differs."""
        if self.observed is None:
            return f"**broken**: {self.failure}"
        complaint = self.row.complaint(self.observed)
        return f"**differs**: {complaint}" if complaint else AS_REQUIRED


def run_rows(
    rows: Sequence[FaultRow], *, jobs: int, progress: Callable[[Result], None]
) -> list[Result]:
    """Run rows: those in real time one after the other, the rest on several processes."""
    found: dict[str, Result] = {}

    def add(result: Result) -> None:
        found[result.row.name] = result
        progress(result)

    for row in rows:
        if row.real_time or jobs == 1:
            add(Result(row, *_run(row)))
    others = [row for row in rows if row.name not in found]
    if others:
        quiet = {"initializer": logging.disable, "initargs": (logging.CRITICAL,)}
        with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), **quiet) as pool:
            seen = pool.map(_run_named, [row.name for row in others])
            for row, values in zip(others, seen, strict=True):
                add(Result(row, *values))
    return [found[row.name] for row in rows]


def _run(row: FaultRow) -> tuple[Observed | None, str, float]:
    """Return what was observed, what broke instead, and how long it took in s."""
    began_s = time.monotonic()
    try:
        observed, failure = row.run(), ""
    except Exception as error:
        observed, failure = None, f"{type(error).__name__}: {error}"
    return observed, failure, time.monotonic() - began_s


def _run_named(name: str) -> tuple[Observed | None, str, float]:
    """Run a row by its name: rows do not pass between processes."""
    return _run(next(row for row in ROWS if row.name == name))
