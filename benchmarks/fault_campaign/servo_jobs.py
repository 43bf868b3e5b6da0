"""What the rows of the servos share: grasps with a fault, and what is there a while later."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    CampaignCell,
    campaign_cell,
    grasp_job,
    observe,
)
from gripper.gripper import GripperPhase

LONG_HOLD = {"kind": "linear", "rate_n_s": 10.0, "hold_s": 3.0}
"""A ramp whose force is held for 3 s."""
_LATER_S = 1.0
_WITH_THE_PART = frozenset({GripperPhase.APPROACHING, GripperPhase.RAMPING})

Job = Callable[[CampaignCell], Any]


def in_a_grasp(
    fault: str,
    *more: str,
    job: Job = grasp_job,
    limp_allowed: bool = False,
    look_again: bool = True,
    **changes: Any,
) -> Observed:
    """Inject faults, run a job, and look again a second later: nobody may have let go.

    Parameters
    ----------
    fault
        Text of the fault whose detection counts.
    more
        Texts of faults that go with it.
    job
        What the cell does.
    limp_allowed
        As in `InvariantMonitor`.
    look_again
        False where the fault goes on by itself.
    changes
        Of the config, see `campaign_config`.
    """
    with campaign_cell(**changes) as cell:
        cell.monitor.limp_allowed = limp_allowed
        for text in more:
            cell.simulated.inject(text)
        seen = observe(cell, fault, job)
        return with_later(cell, seen) if look_again else seen


def grasp_row(  # noqa: PLR0917
    row: int, variant: str, fault: str, injected: str, reaction: str, limit_s: float | None
) -> FaultRow:
    """Return a row of the table whose fault of the vocabulary meets a grasp."""
    return FaultRow(
        row=row,
        variant=variant,
        fault=fault,
        injected=injected,
        reaction=reaction,
        limit_s=limit_s,
        run=partial(in_a_grasp, injected, limp_allowed=reaction == "LIMP"),
    )


def with_later(cell: CampaignCell, seen: Observed) -> Observed:
    """Let a second pass without a host and add what is left of the grip."""
    if seen.reaction in {"NOTE", "NOTHING", "REJECT"}:
        return seen
    cell.simulated.clock.sleep(_LATER_S)
    return replace(seen, outcome=f"{seen.outcome}; {_LATER_S:g} s later {cell.grip_n:.1f} N")


@contextmanager
def first_time(cell: CampaignCell, happens: Callable[[], bool]) -> Iterator[list[float]]:
    """Note the times in s of the first moment within the block at which something happens."""
    found: list[float] = []

    def look(now_s: float) -> None:
        if not found and happens():
            found.append(now_s)

    cell.simulated.clock.on_advance.append(look)
    try:
        yield found
    finally:
        cell.simulated.clock.on_advance.remove(look)


def stopped_pressing(cell: CampaignCell) -> Callable[[], bool]:
    """Return what says that a grasp has begun to close, and closes no more."""
    closing = False

    def happens() -> bool:
        nonlocal closing
        phase = cell.controller.hand.phase
        if phase in _WITH_THE_PART:
            closing = True
            return False
        return closing

    return happens
