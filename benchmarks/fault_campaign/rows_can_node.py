"""Rows 9 to 17: the control unit and its taxels."""

from dataclasses import replace

from benchmarks.fault_campaign._can_jobs import BURST_S, LOOP_S, PERIOD_S, near_cell, plain
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import CampaignCell, observe
from cell.states import CellState
from gripper.ramp import ForceRamp
from tactile.errors import TareRefused

_BOOT_S = 0.02
_STALE_S = 0.1
"""`gripper.force_stale_ms`: control goes on so long on the last force that was good."""
_STUCK_S = 0.5
"""Frames after which a taxel that repeats itself is bad: 25."""
_START_S = 3.0
_BOARDS = [11, 12]


def _reboots() -> Observed:
    """Reboot in a grasp; after clear and reset the next job sets up and zeroes anew."""
    with near_cell() as cell:
        observed = observe(cell, "unit.reboot@contact+0.1s")
        controller = cell.controller
        controller.clear()
        controller.reset()
        with cell.monitor.release_asked():
            controller.release_held()
        controller.start()
        cell.grasp()
        again = controller.state is CellState.IDLE
    return replace(observed, outcome=f"{observed.outcome}; next job {'done' if again else 'not'}")


def _idle_then_grasp(text: str) -> Observed:
    """Inject while the cell is started and waits, then grasp."""

    def job(cell: CampaignCell) -> None:
        cell.idle(0.2)
        cell.grasp()

    with near_cell() as cell:
        cell.start()
        return observe(cell, text, job)


def _preloaded() -> Observed:
    """Take a zero while a part is between the pads."""
    with near_cell() as cell:
        cell.start()
        cell.simulated.place("ball")
        hand = cell.controller.hand
        hand.grasp(ForceRamp.linear(1.0, rate_n_s=10.0, hold_s=0.1), lambda _cycle, _frames: None)
        began_s = cell.now_s
        try:
            hand.tare(10)
        except TareRefused as error:
            after_s = cell.now_s - began_s
            return Observed(
                reaction="REJECT",
                detected_after_s=after_s,
                outcome=f"TareRefused: {error}; the old zero stays, the grip is kept "
                f"({cell.grip_n:.1f} N)",
            )
        return Observed(reaction="NOTHING", detected_after_s=None, outcome="the zero was taken")


ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=9,
        fault="the unit reboots in the ramp; the limit counts its boot of 20 ms",
        injected="unit.reboot@contact+0.1s",
        reaction="HOLD",
        limit_s=_BOOT_S + LOOP_S,
        run=_reboots,
    ),
    plain(10, "heartbeat lost", "unit.heartbeat_off@contact+0.1s", "the heartbeat stops")(
        "HOLD", 0.15 + LOOP_S
    ),
    plain(10, "never appears", "unit.off", "the unit is not there at the start")(
        "REJECT", _START_S + 0.05
    ),
    plain(10, "gone", "unit.off@contact+0.1s", "the unit falls silent")(
        "HOLD", 0.06 + PERIOD_S + LOOP_S
    ),
    plain(
        11,
        "pre-operational",
        "unit.pre_operational@contact+0.1s",
        "the unit falls to pre-operational; its next heartbeat says so",
    )("HOLD", 0.1 + LOOP_S),
    plain(11, "EMCY", "unit.emergency=0x5000@contact+0.1s", "the unit sends an emergency")(
        "HOLD", 2 * LOOP_S
    ),
    plain(12, "second unit at the start", "unit.second_node", "two units with one node-ID")(
        "REJECT", _START_S
    ),
    plain(
        12,
        "second unit joins",
        "unit.second_node@contact+0.1s",
        "a second unit with the same node-ID boots in the ramp",
    )("HOLD", _BOOT_S + 2 * LOOP_S),
    plain(
        12,
        "everything twice",
        "can.duplicate=1@contact",
        "two frames after each SYNC, as of a second unit that did not boot now",
    )("HOLD", 6 * PERIOD_S),
    plain(
        12,
        "another unit",
        "unit.wrong=serial:99",
        "the left unit where the right one belongs",
        tactile__serial_number=1,
    )("REJECT", _START_S),
    plain(12, "another layout", "unit.wrong=taxels:400", "a unit with other pads")(
        "REJECT", _START_S
    ),
    plain(
        12,
        "pads swapped",
        "unit.pads_swapped",
        "the pads of both fingers exchanged at the unit",
        tactile__board_serial_numbers=_BOARDS,
    )("REJECT", _START_S),
    plain(13, "", "unit.stuck@contact+0.1s", "frozen frames: valid, new counter, same samples")(
        "HOLD", 0.1
    ),
    plain(
        13,
        "without noise",
        "unit.stuck@contact+0.1s",
        "frozen frames of a sensor without noise, while the force grows by 1 N",
        simulator__noise="none",
    )("HOLD", 0.2 + PERIOD_S),
    plain(14, "few at the start", "taxels.stuck=0.01", "four taxels at full scale")("NOTE", None),
    plain(14, "many at the start", "taxels.stuck=0.3", "120 taxels at full scale")(
        "REJECT", _START_S
    ),
    plain(14, "few online", "taxels.stuck=0.01@contact+0.1s", "four taxels get stuck high")(
        "NOTE", PERIOD_S + BURST_S + LOOP_S
    ),
    plain(14, "many online", "taxels.stuck=0.3@contact+0.1s", "120 taxels get stuck high")(
        "HOLD", _STALE_S + PERIOD_S + BURST_S
    ),
    plain(15, "few at the start", "taxels.off=0.01", "four taxels read 0")("NOTE", None),
    plain(15, "many at the start", "taxels.off=0.3", "120 taxels read 0")("REJECT", _START_S),
    plain(
        15,
        "few online",
        "taxels.off=0.01@contact",
        "four taxels die",
        sequence__ramp__hold_s=0.5,
    )("NOTE", _STUCK_S + PERIOD_S + BURST_S + LOOP_S),
    plain(15, "many online", "taxels.off=0.3@contact+0.1s", "120 taxels die")(
        "HOLD", _STUCK_S + _STALE_S + PERIOD_S + BURST_S
    ),
    plain(
        16,
        "a gripping pad",
        "taxels.saturated=0@contact+0.1s",
        "a gripping pad saturates: its force is void with the next set, control goes on for "
        "force_stale_ms",
    )("HOLD", _STALE_S + PERIOD_S + BURST_S),
    plain(16, "another pad", "taxels.saturated=1@contact+0.1s", "an outer pad saturates")(
        "NOTE", PERIOD_S + BURST_S + LOOP_S
    ),
    plain(
        17,
        "step up in the ramp",
        "taxels.offset=10@contact+0.1s",
        "all taxels read 4 % more, as after a temperature step; no label is given",
    )("HOLD", _STALE_S + 2 * PERIOD_S),
    plain(
        17,
        "step down in the ramp",
        "taxels.offset=-10@contact+0.1s",
        "all taxels read 4 % less; no label is given",
    )("HOLD", _STALE_S + 3 * PERIOD_S),
    FaultRow(
        row=17,
        variant="drift between grasps",
        fault="the zero has drifted before the next grasp; it is refused with nothing moved",
        injected="taxels.offset=10 in a cell that waits",
        reaction="HOLD",
        limit_s=None,
        run=lambda: _idle_then_grasp("taxels.offset=10"),
    ),
    FaultRow(
        row=17,
        variant="touched while zeroing",
        fault="a part is squeezed between the pads while the zero is taken",
        injected="a zero of ten frames while a ball is gripped with 1 N",
        reaction="REJECT",
        limit_s=0.25,
        run=_preloaded,
    ),
)
