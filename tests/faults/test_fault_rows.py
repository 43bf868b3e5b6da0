"""Each row of the fault campaign: the required reaction, within its limit, no invariant broken."""

from collections.abc import Iterable
from typing import Any

import pytest

from benchmarks.fault_campaign import ROWS, FaultRow, Observed
from benchmarks.fault_campaign.table import Result, complaint_of, rows_table, totals


def _named(rows: Iterable[FaultRow]) -> list[Any]:
    return [pytest.param(row, id=row.name) for row in rows]


@pytest.mark.parametrize("row", _named(row for row in ROWS if not row.real_time))
def test_a_fault_has_its_reaction_within_its_limit(row: FaultRow) -> None:
    observed = row.run()
    assert not complaint_of(row, observed), observed.outcome


@pytest.mark.hil
@pytest.mark.usefixtures("free_machine")
@pytest.mark.parametrize("row", _named(row for row in ROWS if row.real_time))
def test_a_fault_between_processes_has_its_reaction_within_its_limit(row: FaultRow) -> None:
    observed = row.run()
    assert not complaint_of(row, observed), observed.outcome


def test_rows_have_names_of_their_own() -> None:
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert all(1 <= row.row <= 42 for row in ROWS)


def test_the_table_says_what_differs() -> None:
    seen = Observed(reaction="HOLD", detected_after_s=0.2, outcome="kept | held")
    row = FaultRow(
        row=8, fault="x", injected="can.off", reaction="HOLD", limit_s=0.1, run=lambda: seen
    )
    late = Result(row=row, observed=seen, failure="", seconds=0.0)
    assert late.verdict == "**differs**: detected after 200 ms, limit 100 ms"
    never = Observed(reaction="HOLD", detected_after_s=None, outcome="")
    assert complaint_of(row, never) == "never detected, the limit is 100 ms"
    other = Observed(reaction="NOTE", detected_after_s=0.0, outcome="")
    assert complaint_of(row, other) == "reaction NOTE, required is HOLD"
    broken = Result(row=row, observed=None, failure="InvariantBroken: force", seconds=0.0)
    good = Result(
        row=row,
        observed=Observed(reaction="HOLD", detected_after_s=0.01, outcome="kept"),
        failure="",
        seconds=0.0,
    )
    assert "1 with the required reaction within their limit, 2 not" in totals([late, broken, good])
    table = rows_table([late, broken, good])
    assert "| 8 | x | `can.off` | HOLD | 100 ms | 200 ms | kept / held |" in table
    assert "**broken**: InvariantBroken: force" in table
    assert table.endswith("| as required |")
