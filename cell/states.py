"""States of the cell, named as in PackML, and the one table of what may follow what."""

from enum import StrEnum


class CellState(StrEnum):
    """State of the cell (PackML names)."""

    STOPPED = "STOPPED"
    STARTING = "STARTING"
    IDLE = "IDLE"
    EXECUTE = "EXECUTE"
    HOLDING = "HOLDING"
    HELD = "HELD"
    ABORTING = "ABORTING"
    ABORTED = "ABORTED"
    CLEARING = "CLEARING"
    RESETTING = "RESETTING"


class Event(StrEnum):
    """What moves the cell from one state to the next."""

    START = "start"
    STARTED = "started"
    EXECUTE = "execute"
    DONE = "done"
    HOLD = "hold"
    HELD = "held"
    RELEASE = "release"
    FAULT = "fault"
    ABORTED = "aborted"
    CLEAR = "clear"
    CLEARED = "cleared"
    RESET = "reset"
    STOP = "stop"


TRANSITIONS: dict[tuple[CellState, Event], CellState] = {
    (CellState.STOPPED, Event.START): CellState.STARTING,
    (CellState.STARTING, Event.STARTED): CellState.IDLE,
    (CellState.STARTING, Event.STOP): CellState.STOPPED,
    (CellState.IDLE, Event.EXECUTE): CellState.EXECUTE,
    (CellState.EXECUTE, Event.DONE): CellState.IDLE,
    (CellState.EXECUTE, Event.HOLD): CellState.HOLDING,
    (CellState.HOLDING, Event.HELD): CellState.HELD,
    (CellState.HELD, Event.RELEASE): CellState.EXECUTE,
    (CellState.IDLE, Event.RELEASE): CellState.EXECUTE,
    (CellState.ABORTING, Event.ABORTED): CellState.ABORTED,
    (CellState.ABORTED, Event.CLEAR): CellState.CLEARING,
    (CellState.CLEARING, Event.CLEARED): CellState.RESETTING,
    (CellState.RESETTING, Event.RESET): CellState.STOPPED,
    (CellState.IDLE, Event.STOP): CellState.STOPPED,
    (CellState.HELD, Event.STOP): CellState.STOPPED,
    (CellState.STOPPED, Event.STOP): CellState.STOPPED,
    **{
        (state, Event.FAULT): CellState.ABORTING
        for state in CellState
        if state not in (CellState.ABORTED, CellState.ABORTING)
    },
}
"""Every transition there is; a pair that is not listed is refused."""


def next_state(state: CellState, event: Event) -> CellState:
    """Return the state that follows.

    Raises
    ------
    ValueError
        If the event is not allowed in this state; the message lists what is.
    """
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        allowed = sorted(e.value for s, e in TRANSITIONS if s is state and e is not Event.FAULT)
        raise ValueError(
            f"{event.value!r} is not allowed while the cell is {state.value}; "
            f"allowed: {', '.join(allowed) or 'nothing'}"
        ) from None
