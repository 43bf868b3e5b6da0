import pytest

from cell.states import TRANSITIONS, CellState, Event, next_state


def test_every_state_but_aborted_can_fault() -> None:
    for state in CellState:
        if state in (CellState.ABORTED, CellState.ABORTING):
            continue
        assert next_state(state, Event.FAULT) is CellState.ABORTING


def test_leaving_a_fault_takes_clear_and_reset() -> None:
    state = CellState.ABORTED
    assert [e for (s, e) in TRANSITIONS if s is state] == [Event.CLEAR]
    for event in (Event.CLEAR, Event.CLEARED, Event.RESET):
        state = next_state(state, event)
    assert state is CellState.STOPPED


def test_every_state_can_be_reached_and_left() -> None:
    reached = {CellState.STOPPED} | set(TRANSITIONS.values())
    assert reached == set(CellState)
    assert {state for state, _ in TRANSITIONS} == set(CellState)


def test_refusal_names_what_is_allowed() -> None:
    with pytest.raises(
        ValueError, match=r"'execute' is not allowed .* HELD; allowed: release, stop"
    ):
        next_state(CellState.HELD, Event.EXECUTE)
