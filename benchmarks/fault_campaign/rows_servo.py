"""Rows 18 to 30: the servo bus, the servos, the part."""

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import campaign_cell, observe


def _in_a_grasp(fault: str) -> Observed:
    with campaign_cell() as cell:
        return observe(cell, fault)


ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=19,
        variant="cable out",
        fault="the cable of the servo bus is pulled in the ramp",
        injected="servos.unplugged@contact+0.2s",
        reaction="HOLD",
        limit_s=0.1,
        run=lambda: _in_a_grasp("servos.unplugged@contact+0.2s"),
    ),
)
