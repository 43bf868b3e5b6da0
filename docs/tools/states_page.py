"""The tables of the states, made from those that the controller follows."""

from cell.control.states import (
    COMPLETIONS,
    EVENT_OF,
    OF_PHASE,
    TRANSITIONS,
    CellState,
    Command,
    Event,
    GraspState,
    is_allowed,
    next_state,
)

_BOX, _STEP = (112, 34), (225, 120)
"""Width and height of a state in the picture, and from state to state, in its own units."""
_PLACES = {
    CellState.STOPPED: (0, 0),
    CellState.STARTING: (1, 0),
    CellState.IDLE: (2, 0),
    CellState.EXECUTE: (3, 0),
    CellState.COMPLETE: (4, 0.45),
    CellState.STOPPING: (1.6, 1.1),
    CellState.HELD: (3, 1.3),
    CellState.HOLDING: (4, 1.3),
    CellState.RESETTING: (0.5, 1.1),
    CellState.CLEARING: (0, 2),
    CellState.ABORTED: (1.2, 2),
    CellState.ABORTING: (2.2, 2),
}
"""Column and row of each state in the picture."""
DOES = {
    CellState.STOPPED: (
        "There is no command, and the links are not supervised. A cell begins here.",
        "Unchanged: a part of an earlier run or a cleared fault is still held.",
    ),
    CellState.STARTING: (
        "Verifies servos and control unit, opens the fingers, measures the zero of the taxels.",
        "Empty fingers open. Torque that is on is a fault, and nothing moves: a part may be held.",
    ),
    CellState.IDLE: (
        "Ready. Both links are kept alive and supervised (`tick`).",
        "Open and empty, torque on, bus watchdog armed.",
    ),
    CellState.EXECUTE: (
        "Runs a grasp (pose, approach, ramp, hold, release or keep), a release, or a check of a "
        "kept part (`verify`).",
        "Closes, holds, opens; opens only at the planned end of a grasp or by `release`.",
    ),
    CellState.COMPLETE: (
        "The part was named or gripped and is held for the host. The links are supervised, and the "
        "force is controlled (`tick`).",
        "Holds the part with `sequence.carry_force_n`, until `release`; slip and loss are faults.",
    ),
    CellState.HOLDING: (
        "A stop on request is in progress: the ramp is frozen.",
        "Goals are frozen at their last value; the bus watchdog is disarmed.",
    ),
    CellState.HELD: (
        "Stopped on request. The links are supervised (`tick`).",
        "Keeps a held part until `release`.",
    ),
    CellState.STOPPING: (
        "Ends the use of the devices, or releases a part before the start (`release_held`).",
        "A held part stays held; empty fingers lose their torque. `release_held` opens.",
    ),
    CellState.ABORTING: (
        "A fault is being latched: its text is kept, the grip is frozen.",
        "Goals are frozen, torque is unchanged; above the force cap the currents are lowered.",
    ),
    CellState.ABORTED: (
        "A fault is latched. Nothing moves until a person or host has cleared and reset it.",
        "Keeps a held part if the servos still can.",
    ),
    CellState.CLEARING: (
        "Acknowledges a fault, also an earlier one before the start; on request restarts servos. "
        "Or releases the part of an earlier run.",
        "`clear` does not change it (but a restarted servo drops its part); `release_held` opens.",
    ),
    CellState.RESETTING: (
        "The fault is acknowledged; the cell waits for `reset`.",
        "As after the fault; `release_held` opens.",
    ),
}
"""What the cell does in each state, and what the grip does."""

GRASP_DOES = {
    GraspState.IDLE: "The fingers rest; the gripper has no sign of a held part.",
    GraspState.GRIPPING: "Approach and force ramp.",
    GraspState.NO_PART_FOUND: "The last grasp touched nothing; until the fingers move again.",
    GraspState.PART_LOST: "Both pads became empty in a grasp or hold, or a kept part slipped.",
    GraspState.HOLDING: "Force is held, or goals are frozen and a part may be in the grip.",
    GraspState.RELEASING: "The fingers open to release the part.",
    GraspState.POSITIONING: "Empty fingers move to an opening.",
    GraspState.ERROR: "A fault is latched; a part may still be in the grip.",
}
"""What each state of the grip means."""


_KEEPING = (Command.GRIP, Command.VERIFY)
"""Commands that end with the part held for the host."""
_CANCELLED = {CellState.EXECUTE: Event.HOLD, CellState.STARTING: Event.STOP}
"""Event of a cancel while a command runs; other acting states end as usual."""


def command_path(state: CellState, command: Command) -> tuple[CellState, ...] | None:
    """Return the states that a cell passes by a command without a fault, the final one last.

    Empty if its state does not change; None for a command that is refused.
    """
    if not is_allowed(state, command):
        return None
    # A cancel without a running command stays pending for the next one.
    event = _CANCELLED.get(state) if command is Command.CANCEL else EVENT_OF[command]
    if event is None or (state, event) not in TRANSITIONS:
        return ()
    path = [next_state(state, event)]
    while path[-1].acting:
        keeps = command in _KEEPING and path[-1] is CellState.EXECUTE
        path.append(next_state(path[-1], Event.KEPT if keeps else COMPLETIONS[path[-1]]))
    return tuple(path)


def states_page() -> str:
    """Return the tables of states and commands as Markdown."""
    return "\n".join(
        (
            "## States of the cell\n",
            "The cell acts in states with *, and waits in the others.\n",
            _states(),
            "## Commands\n",
            "The table has the result of each command without a fault; others are refused.",
            "A `cancel` in a job stops its next start, grasp or release. A later job withdraws it.",
            "In CLEARING and STOPPING it stops `release_held`. An identification that keeps the",
            "part goes from EXECUTE to COMPLETE. Any fault leads to ABORTING.\n",
            _commands(),
            "## Diagram\n",
            "![The states of the cell and their transitions](../images/states.svg)\n",
            "Dashed transitions happen without a command.\n",
            "## States of the grip\n",
            _grasp_states(),
        )
    )


def states_picture() -> str:
    """Return the states and their transitions as SVG; dashed: without a command."""
    ways: dict[tuple[CellState, CellState], list[str]] = {}
    for (state, event), target in TRANSITIONS.items():
        if event is not Event.FAULT:
            texts = ways.setdefault((state, target), [])
            texts += [] if COMPLETIONS.get(state) is event else [event.value]
    lines = [_way(*ends, ", ".join(texts)) for ends, texts in ways.items()]
    for state in CellState:
        x, y = _centre(state)
        box = f'x="{x - _BOX[0] / 2:g}" y="{y - _BOX[1] / 2:g}" width="{_BOX[0]}"'
        lines.append(f'<rect {box} height="{_BOX[1]}" rx="6"/>')
        lines.append(f'<text class="s" x="{x:g}" y="{y + 5:g}">{state.value}</text>')
    x, y = _centre(CellState.ABORTING)
    note = "from every state but ABORTED, on any fault"
    lines.append(f'<text class="n" x="{x + 70:g}" y="{y + 5:g}">{note}</text>')
    return "\n".join(lines)


def _centre(state: CellState) -> tuple[float, float]:
    column, row = _PLACES[state]
    return 75.0 + column * _STEP[0], 50.0 + row * _STEP[1]


def _way(start: CellState, end: CellState, text: str) -> str:
    """Return an arrow that bends to its right, so that the way back has a line of its own.

    It begins behind the box of its start and ends at the border of the other.
    """
    (x, y), (to_x, to_y) = _centre(start), _centre(end)
    bend_x, bend_y = (x + to_x) / 2 - 0.2 * (to_y - y), (y + to_y) / 2 + 0.2 * (to_x - x)

    def at(t: float) -> tuple[float, float]:
        weights = ((1 - t) ** 2, 2 * t * (1 - t), t**2)
        ends = ((x, bend_x, to_x), (y, bend_y, to_y))
        along, down = (sum(w * a for w, a in zip(weights, one, strict=True)) for one in ends)
        return along, down

    def is_free(t: float) -> bool:
        a, b = at(t)
        return abs(a - to_x) > _BOX[0] / 2 + 2 or abs(b - to_y) > _BOX[1] / 2 + 2

    last = max(filter(is_free, (step / 100 for step in range(101))))
    (end_x, end_y), (text_x, text_y) = at(last), at(0.5)
    by = f"{x + last * (bend_x - x):.1f},{y + last * (bend_y - y):.1f}"
    dashed = "" if text else ' class="own"'
    return (
        f'<path{dashed} d="M{x:g},{y:g} Q{by} {end_x:.1f},{end_y:.1f}" marker-end="url(#a)"/>'
        f'<text class="e" x="{text_x:.0f}" y="{text_y + 4:.0f}">{text}</text>'
    )


def _table(head: tuple[str, ...], rows: list[tuple[str, ...]]) -> str:
    lines = [head, tuple("---" for _ in head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _states() -> str:
    return _table(
        ("number", "state", "what the cell does", "what the grip does"),
        [
            (str(state.number), state.value + (" *" if state.acting else ""), *DOES[state])
            for state in sorted(CellState, key=lambda state: state.number)
        ],
    )


def _commands() -> str:
    def allowed(state: CellState) -> tuple[str, str]:
        paths = {command.value: command_path(state, command) for command in Command}
        leads = [f"`{name}`: {' → '.join(path)}" for name, path in paths.items() if path]
        stays = [f"`{name}`" for name, path in paths.items() if path == ()]
        return "<br>".join(leads), ", ".join(stays)

    return _table(
        ("state", "leads to", "allowed without a change of state"),
        [
            (state.value, *allowed(state))
            for state in sorted(CellState, key=lambda state: state.number)
        ],
    )


def _grasp_states() -> str:
    return _table(
        ("number", "state", "meaning", "phases of the gripper"),
        [
            (
                str(state.number),
                state.value,
                GRASP_DOES[state],
                ", ".join(phase.name for phase, grasp in OF_PHASE.items() if grasp is state),
            )
            for state in GraspState
        ],
    )
