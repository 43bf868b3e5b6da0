"""Each row of the fault campaign: the required reaction, within its limit, no invariant broken.

After it the steps of the fault catalogue lead the cell back to IDLE.
"""

from dataclasses import asdict
from typing import Any

import pytest

from cell.control.plan import Pose
from cell.control.states import CellState
from cell.errors import CellStopped, PartInGrip
from tests.faults.campaign import FaultRow, Observed, campaign_cell, take_steps
from tests.faults.invariants import link_counters
from tests.faults.table import EACH_CHANGE, REACTIONS, ROWS


def parameter(row: FaultRow) -> Any:
    long = row not in EACH_CHANGE and (row.long or not row.real_time)
    kinds = {"real_time": row.real_time, "long": long}
    marks = [getattr(pytest.mark, kind) for kind, holds in kinds.items() if holds]
    return pytest.param(row, id=row.name, marks=marks)


@pytest.mark.slow
@pytest.mark.parametrize("row", [parameter(row) for row in ROWS])
def test_a_fault_has_its_reaction_within_its_limit(row, request, record_property) -> None:
    if row.real_time:
        request.getfixturevalue("free_machine")
    observed = row.run()
    for name, value in asdict(observed).items():
        record_property(name, value)
    assert not row.complaint(observed), observed.outcome


def test_rows_have_names_of_their_own_and_all_reactions_are_there() -> None:
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert {row.reaction for row in ROWS} == set(REACTIONS)


def test_the_monitor_watches_every_counter_of_the_links() -> None:
    with campaign_cell() as cell:
        health = cell.cell.health()
        watched = sum(len(values) for values in link_counters(cell.cell))
    counted = [health[link].keys() for link in ("tactile", "servo_bus")]
    always = {"complete", "transactions", "force_received", "requests", "late_requests"}
    assert watched == sum(len(names - always) for names in counted) > 10


def test_what_differs_from_what_is_required_is_named() -> None:
    row = FaultRow(8, "", "can.off", "HOLD", 0.1)
    assert row.complaint(Observed("HOLD", 0.2, "kept")) == "detected after 200 ms, limit 100 ms"
    assert row.complaint(Observed("HOLD", None, "")) == "never detected, the limit is 100 ms"
    assert row.complaint(Observed("NOTE", 0.0, "")) == "reaction NOTE, required is HOLD"
    assert row.complaint(Observed("HOLD", 0.01, "kept")) == ""


@pytest.mark.slow
def test_the_steps_after_a_stop_and_after_a_part_that_was_left_lead_back_to_idle() -> None:
    with campaign_cell() as cell, cell.monitor.release_asked():
        cell.start()
        life = cell.controller.life
        cell.clock.on_advance.append(lambda _now_s: cell.grip_n > 1.0 and life.cancel())
        with pytest.raises(CellStopped):
            cell.grasp(6.0)
        cell.clock.on_advance.pop()
        take_steps(cell, 512)
        assert cell.controller.life.state is CellState.IDLE
        cell.controller.grip(3.0, Pose())
        cell.controller.shutdown()
        with pytest.raises(PartInGrip):
            cell.controller.start()
        take_steps(cell, 506)
        assert cell.controller.life.state is CellState.IDLE
