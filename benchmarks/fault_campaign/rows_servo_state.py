"""Rows 22 to 27: what servos latch, lose or are set to, and feedback that cannot be."""

from functools import partial

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import campaign_cell, grasp_job, observe
from benchmarks.fault_campaign.servo_jobs import LONG_HOLD, first_time, grasp_row, in_a_grasp

_CYCLE_S = 0.006
"""One period of 5 ms and the transaction that tells."""
_SILENT_S = 0.025
_START_S = 2.0
_ROUND_S = 3.0
"""All verified registers have been read again, one of them every 60 ms."""


def _warm(injected: str) -> Observed:
    """Grasp with a servo that is warm: less current, and somebody counts it."""
    with campaign_cell() as cell:
        with first_time(cell, lambda: cell.controller.hand.statistics.loop.derated > 0) as noted:
            seen = observe(cell, injected, grasp_job)
        if seen.reaction != "NOTHING" or not noted:
            return seen
        began_s = next(f.began_s for f in cell.simulated.devices.injector.faults)
        derated = cell.controller.hand.statistics.loop.derated
        return Observed(
            reaction="NOTE",
            detected_after_s=noted[0] - (began_s or 0.0),
            outcome=f"the current was derated in {derated} periods; {seen.outcome}",
        )


def _register(variant: str, fault: str, setting: str) -> FaultRow:
    return grasp_row(26, variant, fault, f"servo2.wrong={setting}", "REJECT", _START_S)


STATE_ROWS: tuple[FaultRow, ...] = (
    grasp_row(
        22,
        "overload",
        "the overload protection of a servo latches in the ramp",
        "servo1.overload@contact+0.2s",
        "ABORT",
        _CYCLE_S,
    ),
    grasp_row(
        22,
        "electrical shock",
        "the shock protection of a servo latches in the ramp",
        "servo2.error=16@contact+0.2s",
        "ABORT",
        _CYCLE_S,
    ),
    FaultRow(
        row=23,
        variant="warm",
        fault="a servo comes near its largest temperature",
        injected="servo1.overheat=66@contact+0.2s",
        reaction="NOTE",
        limit_s=1.0,
        run=partial(_warm, "servo1.overheat=66@contact+0.2s"),
    ),
    grasp_row(
        23,
        "hot",
        "a servo is warmer than temperature_max_c, below its own limit",
        "servo1.overheat=74@contact+0.2s",
        "HOLD",
        1.0,
    ),
    grasp_row(
        23,
        "latched",
        "a servo switches its torque off for heat",
        "servo1.overheat=90@contact+0.2s",
        "ABORT",
        _CYCLE_S,
    ),
    grasp_row(
        24,
        "dip",
        "the supply of a servo falls to 9 V in the ramp",
        "servo2.supply=9@contact+0.2s",
        "HOLD",
        _CYCLE_S,
    ),
    FaultRow(
        row=24,
        variant="brown-out",
        fault="the supply dips for 50 ms and the servo restarts; silent while it boots",
        injected="servo2.reboot@contact+0.2s, servo2.supply=5@contact+0.2s..contact+0.25s",
        reaction="ABORT",
        limit_s=_SILENT_S,
        run=partial(
            in_a_grasp,
            "servo2.reboot@contact+0.2s",
            "servo2.supply=5@contact+0.2s..contact+0.25s",
        ),
    ),
    grasp_row(
        25,
        "",
        "a servo restarts in the ramp: it is silent while it boots, so three periods are waited",
        "servo1.reboot@contact+0.2s",
        "ABORT",
        _SILENT_S,
    ),
    _register("id", "a servo has another ID", "id:7"),
    _register("baud rate", "a servo is set to another baud rate", "baud_rate:1"),
    _register("model", "a servo is another model", "model_number:1060"),
    _register("current limit", "a current limit in the EEPROM is too low", "current_limit:100"),
    _register("drive mode", "a servo turns the other way round", "drive_mode:1"),
    _register("homing offset", "a servo has a homing offset", "homing_offset:500"),
    _register("shutdown", "a servo's protection is switched off", "shutdown:0"),
    _register("second id", "a servo also listens to the ID of the other", "secondary_id:1"),
    FaultRow(
        row=26,
        variant="while running",
        fault="somebody changes a register in a hold; one is read every 60 ms",
        injected="servo2.wrong=shutdown:0@contact+0.3s",
        reaction="HOLD",
        limit_s=_ROUND_S,
        run=partial(in_a_grasp, "servo2.wrong=shutdown:0@contact+0.3s", sequence__ramp=LONG_HOLD),
    ),
    grasp_row(
        27,
        "encoder jump",
        "the position of a servo leaps by 0.3 rad in the ramp",
        "servo1.jump=0.3@contact+0.2s",
        "LIMP",
        _CYCLE_S,
    ),
    grasp_row(
        27,
        "out of range",
        "the position of a servo leaps to where its finger cannot be",
        "servo2.jump=1.5@contact+0.2s",
        "LIMP",
        _CYCLE_S,
    ),
    grasp_row(
        27,
        "stuck encoder",
        "a position stands still while the empty finger opens; only its goal tells",
        "servo1.stuck@moving+0.05s",
        "HOLD",
        4.0,
    ),
)
