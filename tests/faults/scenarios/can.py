"""Faults of the CAN link and the control unit that the vocabulary alone does not bring about."""

from collections.abc import Callable
from dataclasses import replace

from tests.faults.campaign import (
    CampaignCell,
    FaultRow,
    Observed,
    campaign_cell,
    observe,
    recovered,
)

_SYNC_ID = 0x80
"""COB-ID of SYNC, CiA 301."""
_TOUCH_N = 0.02
"""Force in N on both pads that is a contact, as in the simulator."""


def sets_lost(row: FaultRow, *, lost: Callable[[int], bool], crossing: int) -> Observed:
    """Lose one message of some sets, by the numbers of their SYNCs from 0.

    Time counts from the loss ``crossing``, from 1: the one too many.
    """
    lost_s: list[float] = []

    def lose(number: int) -> None:
        if lost(number):
            cell.simulated.inject("can.lose_next=1")
            lost_s.append(cell.now_s)

    with campaign_cell(row.changes) as cell:
        observed = observe(cell, lambda: _on_sync(cell, lose))
        timed = _since(cell, observed, lost_s[crossing - 1])
    first_s = 1e3 * (lost_s[crossing - 1] - lost_s[0])
    if crossing == 1:
        return timed
    return replace(timed, outcome=f"{timed.outcome} (first loss {first_s:.0f} ms before)")


def adapter_comes_back(row: FaultRow) -> Observed:
    """Pull the adapter out for a moment; back again, the cell must not go on but by a person."""
    with campaign_cell(row.changes) as cell:
        observed = observe(cell, row.injected)
        state = cell.controller.life.state
        cell.simulated.clock.sleep(1.0)
        cell.controller.life.tick()
        if cell.controller.life.state is not state:
            return replace(observed, reaction=f"went from {state} to {cell.controller.life.state}")
        return recovered(cell, row, observed, cell.grasp)


def drifts_between_grasps(row: FaultRow) -> Observed:
    """Inject while the cell is started and waits, then grasp."""

    def job(cell: CampaignCell) -> None:
        cell.idle(0.2)
        cell.grasp()

    with campaign_cell(row.changes) as cell:
        cell.start()
        return observe(cell, row.injected.partition(" ")[0], job)


def _on_sync(cell: CampaignCell, act: Callable[[int], None], *, after: int = 5) -> None:
    """Call ``act`` just before each SYNC reaches the unit, once both pads touch.

    It gets the number of the SYNC, from 0; the first ``after`` of them are left out, so that the
    contact itself is over.
    """
    seen = [-after]

    def look(_t_s: float, can_id: int, _data: bytes) -> None:
        if can_id == _SYNC_ID and (seen[0] > -after or cell.grip_n > _TOUCH_N):
            if seen[0] >= 0:
                act(seen[0])
            seen[0] += 1

    cell.simulated.can_bus.capture.append(look)


def _since(cell: CampaignCell, observed: Observed, began_s: float | None) -> Observed:
    """Return the same with the time counted from ``began_s``."""
    monitor = cell.monitor
    known_s = monitor.latched_s if monitor.latched_s is not None else monitor.noted_s
    if known_s is None or began_s is None:
        return observed
    return replace(observed, detected_after_s=max(0.0, known_s - began_s))
