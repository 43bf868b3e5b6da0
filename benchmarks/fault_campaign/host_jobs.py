"""What several rows of the host share."""

from collections.abc import Callable

from benchmarks.fault_campaign.scenario import (
    CampaignCell,
    campaign_config,
)
from gripper.state import GripperPhase

PERIOD_S = 1.0 / campaign_config().gripper.loop_rate_hz
"""Period of the campaign's force loop in s."""


def once_in(
    cell: CampaignCell, phase: GripperPhase, act: Callable[[], object], *, after_s: float = 0.1
) -> list[float]:
    """Do something once, so long after a phase began; return the list that gets the time of it."""
    began: list[float] = []
    seen: list[float] = []

    def look(now_s: float) -> None:
        if not began and cell.controller.hand.phase is phase:
            seen.append(now_s)
            if now_s - seen[0] >= after_s:
                began.append(now_s)
                act()

    cell.simulated.clock.on_advance.append(look)
    return began
