"""States of the cell and its grip, the table of transitions, and the commands of a host.

Names are those of PackML, numbers those of PackTags (OPC 30050). The lifecycle uses this table. The
page ``docs/reference/faults.md`` and the tests are made from it.
"""

from dataclasses import dataclass
from enum import StrEnum

from gripper.values.outcome import GraspResult
from gripper.values.state import GripperPhase


class GraspState(StrEnum):
    """State of the grip: the action of the fingers; at rest the result of the last grasp.

    Names and numbers are those of the grasping state of Weiss WSG grippers.
    """

    IDLE = "IDLE"
    GRIPPING = "GRIPPING"
    NO_PART_FOUND = "NO PART FOUND"
    PART_LOST = "PART LOST"
    HOLDING = "HOLDING"
    RELEASING = "RELEASING"
    POSITIONING = "POSITIONING"
    ERROR = "ERROR"

    @property
    def number(self) -> int:
        """Number of the state for hosts, 0 to 7."""
        return list(GraspState).index(self)


OF_PHASE = {
    GripperPhase.OFF: GraspState.IDLE,
    GripperPhase.IDLE: GraspState.IDLE,
    GripperPhase.OPENING: GraspState.POSITIONING,
    GripperPhase.APPROACHING: GraspState.GRIPPING,
    GripperPhase.RAMPING: GraspState.GRIPPING,
    GripperPhase.HOLDING: GraspState.HOLDING,
    GripperPhase.BACKING_OFF: GraspState.HOLDING,
    GripperPhase.RELEASING: GraspState.RELEASING,
    GripperPhase.HELD_AFTER_FAULT: GraspState.HOLDING,
}
"""Grasp state of each phase of the gripper without a fault or a failed grasp."""

OF_RESULT = {
    GraspResult.NO_CONTACT: GraspState.NO_PART_FOUND,
    GraspResult.PART_LOST: GraspState.PART_LOST,
}
"""Grasp state after a grasp with this result, until the next command moves the fingers."""


def grasp_state(
    phase: GripperPhase, *, result: GraspResult | None, fault: bool, part_lost: bool
) -> GraspState:
    """Return the state of the grip.

    ``result``: of the last grasp, None before the first one and after a release. ``part_lost``:
    whether the latched fault is the loss of the part.
    """
    if fault:
        return GraspState.PART_LOST if part_lost else GraspState.ERROR
    state = OF_PHASE[phase]
    if state is GraspState.IDLE and result in OF_RESULT:
        return OF_RESULT[result]
    return state


class CellState(StrEnum):
    """State of the cell (PackML names)."""

    STOPPED = "STOPPED"
    STARTING = "STARTING"
    IDLE = "IDLE"
    EXECUTE = "EXECUTE"
    COMPLETE = "COMPLETE"
    HOLDING = "HOLDING"
    HELD = "HELD"
    STOPPING = "STOPPING"
    ABORTING = "ABORTING"
    ABORTED = "ABORTED"
    CLEARING = "CLEARING"
    RESETTING = "RESETTING"

    @property
    def number(self) -> int:
        """Number of the state for hosts, that of PackTags: see also `needs_reset`."""
        return _NUMBERS[self]

    @property
    def acting(self) -> bool:
        """Whether the cell leaves the state by itself: a command runs or a fault is handled."""
        return self in COMPLETIONS

    @property
    def needs_reset(self) -> bool:
        """Whether an acknowledged fault waits for a reset; the number is that of STOPPED."""
        return self is CellState.RESETTING


class Event(StrEnum):
    """Events that lead from one state to the next."""

    START = "start"
    STARTED = "started"
    EXECUTE = "execute"
    DONE = "done"
    KEPT = "kept"
    VERIFY = "verify"
    HOLD = "hold"
    HELD = "held"
    RELEASE = "release"
    RELEASE_HELD = "release_held"
    FAULT = "fault"
    ABORTED = "aborted"
    CLEAR = "clear"
    CLEARED = "cleared"
    RESET = "reset"
    STOP = "stop"
    STOPPED = "stopped"


class Command(StrEnum):
    """Commands of a person or host, named as the methods of `CellController` and its parts."""

    START = "start"
    GRASP = "grasp"
    GRIP = "grip"
    VERIFY = "verify"
    CANCEL = "cancel"
    RELEASE = "release"
    RELEASE_HELD = "release_held"
    CLEAR = "clear"
    RESET = "reset"
    SHUTDOWN = "shutdown"


_NUMBERS = {
    CellState.CLEARING: 1,
    CellState.STOPPED: 2,
    CellState.RESETTING: 2,
    CellState.IDLE: 4,
    CellState.EXECUTE: 6,
    CellState.STOPPING: 7,
    CellState.ABORTING: 8,
    CellState.ABORTED: 9,
    CellState.HOLDING: 10,
    CellState.HELD: 11,
    CellState.STARTING: 15,
    CellState.COMPLETE: 17,
}
"""Number of each state in PackTags (OPC 30050; Beckhoff `E_PMLState`). PackML's Resetting is what
happens in STARTING; the cell's RESETTING waits stopped until a fault is reset."""

COMPLETIONS: dict[CellState, Event] = {
    CellState.STARTING: Event.STARTED,
    CellState.EXECUTE: Event.DONE,
    CellState.HOLDING: Event.HELD,
    CellState.STOPPING: Event.STOPPED,
    CellState.ABORTING: Event.ABORTED,
    CellState.CLEARING: Event.CLEARED,
}
"""The event that ends each acting state on success. EXECUTE ends with KEPT instead if the part is
held for the host."""

TRANSITIONS: dict[tuple[CellState, Event], CellState] = {
    (CellState.STOPPED, Event.START): CellState.STARTING,
    (CellState.STOPPED, Event.RELEASE_HELD): CellState.STOPPING,
    (CellState.STOPPED, Event.CLEAR): CellState.CLEARING,
    (CellState.STARTING, Event.STARTED): CellState.IDLE,
    (CellState.STARTING, Event.STOP): CellState.STOPPING,
    (CellState.IDLE, Event.EXECUTE): CellState.EXECUTE,
    (CellState.IDLE, Event.RELEASE): CellState.EXECUTE,
    (CellState.IDLE, Event.STOP): CellState.STOPPING,
    (CellState.EXECUTE, Event.DONE): CellState.IDLE,
    (CellState.EXECUTE, Event.KEPT): CellState.COMPLETE,
    (CellState.EXECUTE, Event.HOLD): CellState.HOLDING,
    (CellState.COMPLETE, Event.VERIFY): CellState.EXECUTE,
    (CellState.COMPLETE, Event.RELEASE): CellState.EXECUTE,
    (CellState.COMPLETE, Event.STOP): CellState.STOPPING,
    (CellState.HOLDING, Event.HELD): CellState.HELD,
    (CellState.HELD, Event.RELEASE): CellState.EXECUTE,
    (CellState.HELD, Event.STOP): CellState.STOPPING,
    (CellState.STOPPING, Event.STOPPED): CellState.STOPPED,
    (CellState.ABORTING, Event.ABORTED): CellState.ABORTED,
    (CellState.ABORTED, Event.CLEAR): CellState.CLEARING,
    (CellState.CLEARING, Event.CLEARED): CellState.RESETTING,
    (CellState.RESETTING, Event.RELEASE_HELD): CellState.CLEARING,
    (CellState.RESETTING, Event.RESET): CellState.STOPPED,
    **{
        (state, Event.FAULT): CellState.ABORTING
        for state in CellState
        if state not in (CellState.ABORTED, CellState.ABORTING)
    },
}
"""All transitions; a pair that is not listed is refused."""

_OTHER_EVENTS = {"grasp": Event.EXECUTE, "grip": Event.EXECUTE, "shutdown": Event.STOP}
EVENT_OF: dict[Command, Event] = {
    command: _OTHER_EVENTS.get(command) or Event(command)
    for command in Command
    if command is not Command.CANCEL
}
"""Event of each command, mostly the event of the same name; a cancel has several."""


def next_state(state: CellState, event: Event) -> CellState:
    """Return the state that follows.

    Raises ValueError if the event is not allowed in this state; the message lists what is.
    """
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        asked = (command for command, its_event in EVENT_OF.items() if its_event is event)
        raise ValueError(refusal(state, next(asked, event))) from None


_OF_HOSTS = {"start": "reset", "release_held": "release", "grasp": "identify, teach, sort"}
"""Names by which hosts ask for commands that have another name here."""


def refusal(state: CellState, asked: Command | Event) -> str:
    """Return the message that a command is not allowed in a state, and those that hosts can ask."""
    allowed = [
        _OF_HOSTS.get(command.value, command.value)
        for command in Command
        if is_allowed(state, command) and (state, EVENT_OF.get(command)) in TRANSITIONS
    ]
    listed = ", ".join(dict.fromkeys(allowed)) or Command.CANCEL.value
    return f"the cell is {state.value}; allowed: {listed}; {asked.value!r} is not allowed"


def is_allowed(state: CellState, command: Command) -> bool:
    """Return whether a command is allowed in a state; a cancel always is."""
    if command is Command.SHUTDOWN:
        return not state.acting
    return command is Command.CANCEL or (state, EVENT_OF[command]) in TRANSITIONS


@dataclass(frozen=True, slots=True, kw_only=True)
class CellStatus:
    """State of cell and grip at one moment, for hosts that show or forward it."""

    state: str
    state_number: int
    """PackML name, and number in PackTags."""
    needs_reset: bool
    """Whether an acknowledged fault waits for `reset`; the number is then that of STOPPED."""
    grasp: str
    grasp_number: int
    """State of the grip, and its number."""
    holding: bool
    """Whether a part may be in the grip."""
    fault: str | None
    """The fault, while one is latched."""
    fault_number: int
    """Its number in the fault catalogue; 0 for none."""
    since_s: float = 0.0
    """Unix time in s since which the cell is in its state."""
    fault_since_s: float | None = None
    """Unix time in s at which the fault was latched; None where there is none."""
    n_faults: int = 0
    """Faults latched since the cell was opened."""
