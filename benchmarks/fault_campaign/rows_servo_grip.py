"""Rows 28 to 30: the part, too much force, a bus watchdog that does not act."""

from dataclasses import replace
from functools import partial

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import CampaignCell, campaign_cell, grasp_job, observe
from benchmarks.fault_campaign.servo_jobs import (
    LONG_HOLD,
    first_time,
    in_a_grasp,
    stopped_pressing,
    with_later,
)
from cell.errors import NoPartFound

_LOST_S = 0.05
_LOST_IN_RAMP_S = 0.08
"""The force that is given is the mean of three frames of 20 ms: it is zero with the third."""
_SLID_S = 0.2
"""At 20 mm/s and 3 N: 2 mm of way, and the mean of the sensor; 50 ms would be 1 mm, its noise."""
_CAP_N = 6.0
_SET_S = 0.06
"""Three sets of the sensor, which is the mean that it gives."""


def _without_part(fault: str, told: str) -> Observed:
    """Grasp while the part goes; time runs until the fingers press no more."""
    with campaign_cell(sequence__ramp=LONG_HOLD) as cell:
        injected = cell.simulated.inject(fault)
        told_texts: list[str] = []

        def job(cell: CampaignCell) -> None:
            try:
                grasp_job(cell)
            except NoPartFound as error:
                told_texts.append(str(error))

        with first_time(cell, stopped_pressing(cell)) as known_s:
            seen = observe(cell, lambda: None, job)
        if not told_texts or not known_s or injected.began_s is None:
            return seen
        return Observed(
            reaction=told,
            detected_after_s=known_s[0] - injected.began_s,
            outcome=f"{told_texts[0]}; {cell.controller.state.value}, the fingers are open",
        )


def _pushed(injected: str, reaction: str) -> Observed:
    """Grasp while something pushes back; time counts from the moment at which the cap is passed."""
    with campaign_cell(
        sequence__ramp=LONG_HOLD,
        sequence__force_n=[2.0, 4.0],
        gripper__force_max_n=_CAP_N,
        gripper__over_force__reaction=reaction,
    ) as cell:
        cell.monitor.world_pushes = True
        cell.monitor.limp_allowed = reaction == "limp"
        world = cell.simulated.world
        with first_time(cell, lambda: max(world.contact_force_n()) > _CAP_N) as over_s:
            seen = observe(cell, injected)
        latched_s = cell.monitor.latched_s
        if latched_s is None or not over_s:
            return seen
        return with_later(cell, replace(seen, detected_after_s=latched_s - over_s[0]))


def _too_much(reaction: str, told: str) -> FaultRow:
    injected = "object.trapped=3@contact+0.8s"
    return FaultRow(
        row=29,
        variant=f"reaction {reaction}",
        fault=f"something trapped pushes the force above its cap of {_CAP_N:g} N in a hold; time "
        "counts from the cap",
        injected=injected,
        reaction=told,
        limit_s=_SET_S,
        run=partial(_pushed, injected, reaction),
    )


GRIP_ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=28,
        variant="no part",
        fault="the part is taken away in the approach: the fingers close to their limit",
        injected="object.gone@moving+0.6s",
        reaction="NO PART FOUND",
        limit_s=1.5,
        run=partial(_without_part, "object.gone@moving+0.6s", "NO PART FOUND"),
    ),
    FaultRow(
        row=28,
        variant="part lost in the ramp",
        fault="the part is taken out of the fingers in the ramp",
        injected="object.gone@contact+0.3s",
        reaction="PART LOST",
        limit_s=_LOST_IN_RAMP_S,
        run=partial(_without_part, "object.gone@contact+0.3s", "PART LOST"),
    ),
    FaultRow(
        row=28,
        variant="part lost in a hold",
        fault="the part is taken out of the fingers while it is held",
        injected="object.gone@contact+1.5s",
        reaction="PART LOST",
        limit_s=_LOST_S,
        run=partial(_without_part, "object.gone@contact+1.5s", "PART LOST"),
    ),
    FaultRow(
        row=28,
        variant="part slips",
        fault="the held part slides along the pads with 20 mm/s",
        injected="object.slips=20@contact+1.5s",
        reaction="HOLD",
        limit_s=_SLID_S,
        run=partial(
            in_a_grasp,
            "object.slips=20@contact+1.5s",
            look_again=False,
            sequence__ramp=LONG_HOLD,
        ),
    ),
    _too_much("lower", "HOLD"),
    _too_much("open", "HOLD"),
    _too_much("limp", "LIMP"),
    FaultRow(
        row=30,
        variant="",
        fault="the bus watchdog of a servo trips and the motor turns on; the self-test is on",
        injected="servo2.watchdog_off",
        reaction="REJECT",
        limit_s=3.0,
        run=partial(in_a_grasp, "servo2.watchdog_off", gripper__watchdog_self_test=True),
    ),
)
