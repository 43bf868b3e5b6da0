"""Row 42: commands out of order."""

from collections.abc import Callable
from typing import Any

from benchmarks.fault_campaign.host_jobs import PERIOD_S, once_in
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    CampaignCell,
    campaign_cell,
    grasp_job,
    observe,
)
from cell.errors import CellStateError, CellStopped
from cell.states import CellState
from gripper.state import GripperPhase


def _refused(prepare: Callable[[CampaignCell], object], command: str) -> Observed:
    """Give a command in a state that does not allow it, and look at what it changed."""
    with campaign_cell() as cell:
        prepare(cell)
        return _refusal(cell, command)


def _refusal(cell: CampaignCell, command: str) -> Observed:
    def seen() -> tuple[Any, ...]:
        hand = cell.controller.hand
        return (cell.controller.state, hand.phase, repr(hand.statistics.servo_bus), cell.now_s)

    before = seen()
    try:
        getattr(cell.controller, command)()
    except CellStateError as error:
        same = seen() == before
        return Observed(
            reaction="REJECT" if same else "CHANGED",
            detected_after_s=0.0,
            outcome=f"{error}; nothing was sent",
        )
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="it was carried out")


def _while_moving(command: str) -> Observed:
    with campaign_cell() as cell:
        refusals: list[Observed] = []
        once_in(cell, GripperPhase.RAMPING, lambda: refusals.append(_refusal(cell, command)))
        cell.start()
        cell.grasp()
        return refusals[0]


def _aborted(cell: CampaignCell) -> None:
    cell.simulated.inject("can.off@contact+0.2s")
    observe(cell, lambda: None)


def _cancelled(times: int, phase: GripperPhase, *, at_start: bool = False) -> Observed:
    with campaign_cell() as cell:

        def cancel() -> None:
            for _ in range(times):
                cell.controller.cancel()

        began = once_in(cell, phase, cancel, after_s=0.0 if at_start else 0.1)
        try:
            if at_start:
                cell.controller.start()
            else:
                grasp_job(cell)
        except CellStopped as stop:
            after_s = cell.now_s - began[0]
            state = cell.controller.state
            cell.idle(0.5)
            settled = state in (CellState.HELD, CellState.STOPPED)
            return Observed(
                reaction="HOLD" if settled else state.value,
                detected_after_s=after_s,
                outcome=f"{stop}; {state.value} ({cell.grip_n:.1f} N)",
            )
        return Observed(reaction="NOTHING", detected_after_s=None, outcome="it went on")


def _rows() -> list[FaultRow]:
    rows = [
        FaultRow(
            row=42,
            variant=variant,
            fault=f"`{command}` while the cell is {state}",
            injected=command,
            reaction="REJECT",
            limit_s=PERIOD_S,
            run=run,
        )
        for variant, command, state, run in (
            ("double start", "start", "IDLE", lambda: _refused(CampaignCell.start, "start")),
            (
                "release while moving",
                "release",
                "EXECUTE",
                lambda: _while_moving("release"),
            ),
            ("start while moving", "start", "EXECUTE", lambda: _while_moving("start")),
            ("shutdown while moving", "shutdown", "EXECUTE", lambda: _while_moving("shutdown")),
            ("reset without clear", "reset", "ABORTED", lambda: _refused(_aborted, "reset")),
            ("release without clear", "release", "ABORTED", lambda: _refused(_aborted, "release")),
        )
    ]
    rows += [
        FaultRow(
            row=42,
            variant=variant,
            fault=fault,
            injected="cancel",
            reaction="HOLD",
            limit_s=2 * PERIOD_S,
            run=run,
        )
        for variant, fault, run in (
            (
                "cancel during start",
                "the start is cancelled while the fingers open",
                lambda: _cancelled(1, GripperPhase.OPENING, at_start=True),
            ),
            (
                "cancel twice",
                "a grasp is cancelled twice in the ramp",
                lambda: _cancelled(2, GripperPhase.RAMPING),
            ),
        )
    ]
    return rows


ROWS: tuple[FaultRow, ...] = tuple(_rows())
