"""Faults of servos and part that need more than a grasp with a fault of the vocabulary."""

from collections.abc import Callable
from dataclasses import replace

from benchmarks.performance.force_cap import trial
from cell.errors import NoPartFound
from gripper.values.state import GripperPhase
from tests.faults.campaign import (
    CampaignCell,
    FaultRow,
    Observed,
    campaign_cell,
    grasp_job,
    later,
    observe,
)

CAP_N = 5.0
"""Cap of the force in N in the rows of something trapped: below the default, soon reached."""
_SEARCHED = range(20_000, 20_012)
"""Seeds of the configs that a row of the campaign grasps with."""
_WITH_THE_PART = frozenset({GripperPhase.APPROACHING, GripperPhase.RAMPING})


def part_leaves(row: FaultRow) -> Observed:
    """Grasp while the part goes; time runs until the fingers press no more."""
    with campaign_cell(row.changes) as cell:
        injected = cell.simulated.inject(row.injected)
        refusals: list[str] = []

        def job(cell: CampaignCell) -> None:
            try:
                grasp_job(cell)
            except NoPartFound as error:
                refusals.append(str(error))

        with cell.first_time(_stopped_pressing(cell)) as known_s:
            seen = observe(cell, job=job)
        if not refusals or not known_s or injected.began_s is None:
            return seen
        return Observed(
            row.reaction,
            known_s[0] - injected.began_s,
            f"{refusals[0]}; {cell.controller.life.state.value}, the fingers are open",
        )


def _stopped_pressing(cell: CampaignCell) -> Callable[[], bool]:
    """Return a test for a grasp that has begun to close and closes no more."""
    closing = False

    def happens() -> bool:
        nonlocal closing
        phase = cell.controller.hand.phase
        if phase in _WITH_THE_PART:
            closing = True
            return False
        return closing

    return happens


def something_pushes(row: FaultRow) -> Observed:
    """Grasp while something pushes back; time counts from the moment the cap is passed."""
    with campaign_cell(row.changes) as cell:
        cell.monitor.world_pushes = True
        cell.monitor.limp_allowed = row.reaction == "LIMP"
        world = cell.simulated.world
        with cell.first_time(lambda: max(world.contact_force_n()) > CAP_N) as over_s:
            seen = observe(cell, row.injected)
        latched_s = cell.monitor.latched_s
        if latched_s is None or not over_s:
            return seen
        return later(cell, replace(seen, detected_after_s=latched_s - over_s[0]))


def fast_approach(row: FaultRow) -> Observed:
    """Grasp with a config that asks for more speed than can be stopped."""
    with campaign_cell(row.changes) as cell:
        return observe(cell)


def random_configs(_row: FaultRow) -> Observed:
    """Grasp once with each of some configs that were drawn; the true force stays below the cap."""
    found = [trial(seed) for seed in _SEARCHED]
    broken = [one for one in found if one.broken]
    if broken:
        return Observed("ABOVE THE CAP", None, str(broken[0]))
    gripped = [one for one in found if not one.refused]
    highest = max(one.true_n / one.cap_n for one in gripped)
    return Observed(
        "NOTHING",
        None,
        f"{len(gripped)} gripped, {len(found) - len(gripped)} were refused; the largest true force "
        f"was {highest:.2f} of its cap",
    )
