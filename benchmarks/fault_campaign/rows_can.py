"""Rows 1 to 17: the CAN link, the control unit, the taxels."""

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import campaign_cell, observe


def _in_a_grasp(fault: str) -> Observed:
    with campaign_cell() as cell:
        return observe(cell, fault)


ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=8,
        variant="bus-off",
        fault="the host's CAN controller goes bus-off in the ramp",
        injected="can.off@contact+0.2s",
        reaction="HOLD",
        limit_s=0.1,
        run=lambda: _in_a_grasp("can.off@contact+0.2s"),
    ),
)
