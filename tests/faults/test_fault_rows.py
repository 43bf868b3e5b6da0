"""Each row of the fault campaign: the required reaction, within its limit, no invariant broken."""

from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import pytest

from tests.faults.campaign import FaultRow, Observed, campaign_cell
from tests.faults.invariants import link_counters
from tests.faults.table import REACTIONS, ROWS

FIRST = {row.row: row for row in reversed(ROWS) if not row.real_time}
"""One variant of each kind; `make test-long` and `make campaign` bring all."""


def parameter(row: FaultRow) -> Any:
    kind = "real_time" if row.real_time else "long"
    marks = () if FIRST.get(row.row) is row else getattr(pytest.mark, kind)
    return pytest.param(row, id=row.name, marks=marks)


@pytest.mark.parametrize("row", [parameter(row) for row in ROWS])
def test_a_fault_has_its_reaction_within_its_limit(
    row: FaultRow, request: pytest.FixtureRequest, record_property: Callable[[str, object], None]
) -> None:
    if row.real_time:
        request.getfixturevalue("free_machine")
    observed = row.run()
    for name, value in asdict(observed).items():
        record_property(name, value)
    assert not row.complaint(observed), observed.outcome


def test_all_kinds_are_there_and_rows_have_names_of_their_own() -> None:
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert {row.row for row in ROWS} == set(range(1, 45))
    assert {row.reaction for row in ROWS} == set(REACTIONS)


def test_the_monitor_watches_every_counter_of_the_links() -> None:
    with campaign_cell() as cell:
        health = cell.cell.health()
        watched = sum(len(values) for values in link_counters(cell.cell))
    counted = [health[link].keys() for link in ("tactile", "servo_bus")]
    always = {"complete", "transactions", "force_received"}
    assert watched == sum(len(names - always) for names in counted) > 10


def test_what_differs_from_what_is_required_is_named() -> None:
    row = FaultRow(8, "", "x", "can.off", "HOLD", 0.1)
    assert row.complaint(Observed("HOLD", 0.2, "kept")) == "detected after 200 ms, limit 100 ms"
    assert row.complaint(Observed("HOLD", None, "")) == "never detected, the limit is 100 ms"
    assert row.complaint(Observed("NOTE", 0.0, "")) == "reaction NOTE, required is HOLD"
    assert row.complaint(Observed("HOLD", 0.01, "kept")) == ""
