"""How rows 1 to 17 bring their faults about and time them."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import CampaignCell, campaign_cell, observe
from simulator.faults import InjectedFault

LOOP_S = 0.005
"""Period of the loop: what was received is looked at so late at most."""
BURST_S = 0.0075
"""A frame is whole so long after its SYNC."""
PERIOD_S = 0.02
"""Of SYNC."""
_SYNC_ID = 0x80
_TOUCH_N = 0.02
_OPENING_MM = 11.0
"""A little more than the ball: short ways to the contact."""


def near_cell(**changes: Any) -> AbstractContextManager[CampaignCell]:
    """Give a `campaign_cell` with fingers that are close to the part."""
    return campaign_cell(**({"gripper__aperture_open_mm": _OPENING_MM} | changes))


def in_a_grasp(text: str, **changes: Any) -> Observed:
    """Grasp with a fault of the vocabulary; changes as `campaign_config`."""
    with near_cell(**changes) as cell:
        return observe(cell, text)


def plain(row: int, variant: str, text: str, fault: str, **changes: Any) -> Callable[..., FaultRow]:
    """Return a maker of a row that is one fault of the vocabulary in one grasp."""

    def make(reaction: str, limit_s: float | None) -> FaultRow:
        return FaultRow(
            row=row,
            variant=variant,
            fault=fault,
            injected=text,
            reaction=reaction,
            limit_s=limit_s,
            run=lambda: in_a_grasp(text, **changes),
        )

    return make


def on_sync(cell: CampaignCell, act: Callable[[int], None], *, after: int = 5) -> None:
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


def from_a_sync(text: str, **changes: Any) -> Observed:
    """Grasp, and inject with a SYNC: its set is the first that is lost, the time counts from it."""
    injected: list[InjectedFault] = []

    def inject(number: int) -> None:
        if number == 0:
            injected.append(cell.simulated.inject(text))

    with near_cell(**changes) as cell:
        observed = observe(cell, lambda: on_sync(cell, inject))
        return since(cell, observed, injected[0].began_s)


def since(cell: CampaignCell, observed: Observed, began_s: float | None) -> Observed:
    """Return the same with the time counted from ``began_s``."""
    monitor = cell.monitor
    known_s = monitor.latched_s if monitor.latched_s is not None else monitor.noted_s
    if known_s is None or began_s is None:
        return observed
    return replace(observed, detected_after_s=max(0.0, known_s - began_s))


def sets_lost(which: Callable[[int], bool], *, crossing: int, hold_s: float = 0.3) -> Observed:
    """Grasp while one message of some sets is lost.

    Parameters
    ----------
    which
        Says for the number of a SYNC whether its set is lost.
    crossing
        The time counts from the loss with this number, from 1: it is the one too many.
    hold_s
        Time at the final force in s.
    """
    lost_s: list[float] = []

    def lose(number: int) -> None:
        if which(number):
            cell.simulated.faults.can.drop_next = 1
            lost_s.append(cell.now_s)

    with near_cell(sequence__ramp__hold_s=hold_s) as cell:
        observed = observe(cell, lambda: on_sync(cell, lose))
        timed = since(cell, observed, lost_s[crossing - 1])
    first_s = 1e3 * (lost_s[crossing - 1] - lost_s[0])
    if crossing == 1:
        return timed
    return replace(timed, outcome=f"{timed.outcome} (first loss {first_s:.0f} ms before)")
