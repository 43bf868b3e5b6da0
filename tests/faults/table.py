"""The rows of the fault campaign as data: kinds of fault in their variants.

A record is: kind, variant, what is injected, required reaction, limit in s until it is detected
(None where no time applies), number of the fault; then, where the text of the simulator's
vocabulary and one grasp do not do, the scenario, and changes of the config. `tactile-cell simulate
--list-faults` says what each text of the vocabulary does.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from cell.config.file import load_config
from tests.faults import campaign
from tests.faults.campaign import FaultRow, campaign_config, carry_with_fault, grasp_with_fault

REACTIONS = {
    "REJECT": "the start, command or file is refused, cause and remedy are named",
    "NOTE": "counted and kept in the record; the job goes on",
    "HOLD": "the ramp stops, goals stay at their last values, the grip is kept; clear and reset "
    "needed",
    "LIMP": "torque off: position or force of the fingers is not known, or the force is over the "
    "cap",
    "ABORT": "as HOLD, and a servo has lost its torque by itself: the part is possibly dropped",
    "NO PART FOUND": "the fingers stop and open again, nothing is learnt or classified",
    "PART LOST": "the same, after the part was touched",
    "NOTHING": "the job is done as without the fault",
}
"""What a cell does about a fault."""

LOOP_S = 1.0 / campaign_config().gripper.loop_rate_hz
"""Period of the force loop: what was received is looked at so late at most."""
READ_S = 0.001
"""Reading of both servos, after which the pads are looked at."""
SYNC_S = 0.02
"""Period of SYNC."""
BURST_S = 0.0075
"""A frame is whole so long after its SYNC."""
SETS_S = 0.06 + LOOP_S + READ_S
"""Three sets that are missing, counted from the first, and the next look, after a reading."""
BOOT_S = 0.02
"""Of the control unit."""
FORCE_STALE_S = 0.1
"""`gripper.force_stale_ms`: control goes on so long on the last force that was good."""
STUCK_S = 0.5
"""A taxel that repeats itself is bad after 25 frames."""
START_S = 3.0
"""A start with a wrong unit is refused within this time."""
BUS_LOST_S = 0.1
"""`gripper.bus_loss_ms`."""
LOSSY_S = 1.5
"""`gripper.bus_loss_ms` over `gripper.feedback_loss_max_share`, and some periods."""
ONE_SILENT_S = 0.025
"""Three periods with their repetitions, and what is left of the one in which it began."""
CYCLE_S = LOOP_S + 0.0035
"""One period, the transaction that shows it, and a step of the simulated clock."""
STANDING_S = 0.2
"""Empty fingers are watched for so long after their torque has come on."""
DRIFT_S = 0.5
"""0.3 rad/s make the 5 to 7 mm that no part explains in 0.4 s; 0.1 s of contradiction count."""
VERIFY_S = 2.0
"""All registers are verified within this time."""
VERIFY_AGAIN_S = 3.0
"""All verified registers have been read again, one of them every 60 ms."""
LOWER_S = 0.4
"""The currents of too much force have fallen before the fault is reported."""
SIGNAL_S = 0.5
"""From a signal in real time until the program or its loop has ended."""
AXIS_S = 0.05
"""Devices of axes are asked every 5 ms; one that does not answer is asked again."""
HEARTBEAT_S = 0.125 + AXIS_S
"""Two periods and a half of a drive's heartbeat, and the wait for an answer."""
WRIST_LOST_S = 0.1 + AXIS_S
"""Time for which a wrist may be silent, and the last wait for an answer."""
FORCES_S = 0.042 + CYCLE_S
"""Force messages that are missing for so long, counted from the last one, and the next look."""
FOLLOWING_S = 0.4
"""1 mm or degree behind at the profile's speed, 50 ms allowed for it, and the start-up of both."""
STALL_S = 0.6
"""8 degrees behind at 90 degrees a second, and 0.15 s allowed for it; the wrist speeds up first."""
BOARD_S = 0.012
"""Period of the slowest board with its jitter."""
BOARD_SILENT_S = 0.08 + 2 * LOOP_S + 0.002
"""Eight periods of a board without a frame are a fault; the last one is on the line for 2 ms."""
USKIN_SILENT_S = 0.07 + 2 * LOOP_S
"""Six periods of a board on CAN without a whole cycle are a fault."""


def _preset(name: str, *sections: str) -> dict[str, Any]:
    """Return the sensor of an example config, boards without counter and checksum, and sections."""
    config = load_config(Path(__file__).parents[2] / "config" / f"{name}.yaml")
    values = config.model_dump(mode="json")
    return {one: values[one] for one in ("tactile", "self_zero", *sections)} | {
        "simulator.servos": values["simulator"]["servos"]
    }


FLEXITAC, OF_USKIN = _preset("flexitac"), _preset("uskin")
OF_RH_P12 = _preset("rh-p12-rn", "gripper") | {"gripper.aperture_open_mm": 14.0}
LONG_HOLD = {"sequence.ramp.hold_s": 3.0}
PAPER_PADS = {"tactile.layout": "paper"}
NOISELESS = {"simulator.noise_level": 0.0, "gripper.aperture_open_mm": 13.6}
"""A sensor without noise, and an approach whose touch frames and force messages show alike."""
EQUAL = {"simulator.servos.gearing": "ideal"}
"""Servos of the same friction: fingers that meet do so in the middle."""
WIDE = {"gripper.aperture_open_mm": 16.0}
FRAME_S = SYNC_S + BURST_S
"""A whole frame of a later scan is there after so long at most."""
HOUR_S = 3600.0
at_six_newtons = partial(grasp_with_fault, force_n=6.0)
OVERRUNS_MAX = campaign_config().loop.overruns_max


def _with(changes: Mapping[str, Any], rows: Iterable[FaultRow]) -> tuple[FaultRow, ...]:
    """Return rows for a cell with these changes, too."""
    return tuple(replace(row, changes={**changes, **row.changes}) for row in rows)


# fmt: off
CAN_BUS = (
    # One tactile frame lost (one message of it).
    FaultRow(1, "", "can.lose_next=1@contact+0.1s", "NOTE", 2 * SYNC_S + BURST_S + LOOP_S,
             changes={"tactile.force_period_ms": 0}),
    FaultRow(2, "silence", "can.loss=1@contact+0.1s", "HOLD", SETS_S + SYNC_S, 401),
    # Every fifth message comes twice.
    FaultRow(3, "", "can.duplicate=0.2@contact", "NOTE", None),
    FaultRow(4, "reordered", "can.swapped=0.2@contact", "NOTE", None),
    # Messages held back for 100 ms; the grip is held as for lost sets.
    FaultRow(4, "late by 100 ms", "can.delayed=0.1@contact+0.1s", "HOLD", SETS_S + SYNC_S, 401),
    FaultRow(5, "corrupt payload", "can.garbage=1@contact+0.14s..contact+0.16s", "NOTE",
             SYNC_S + BURST_S + LOOP_S),
    FaultRow(5, "corrupt payload often", "can.garbage=0.01@contact+0.1s", "HOLD", 0.3, 401,
             changes=PAPER_PADS),
    FaultRow(5, "wrong length", "can.wrong_dlc=0.05@contact+0.1s..contact+0.12s", "NOTE", None),
    # A heartbeat that is cut to no byte is a boot-up.
    FaultRow(5, "wrong length often", "can.wrong_dlc=0.5@contact+0.1s", "HOLD", SETS_S, (307, 308),
             changes=PAPER_PADS),
    FaultRow(5, "short payload", "can.short=0.5@contact+0.1s", "HOLD", SETS_S, 307),
    FaultRow(5, "unknown COB-ID", "can.flood=20@contact", "NOTE", 0.05 + LOOP_S),
    FaultRow(5, "unknown COB-ID often", "can.flood=4000@contact", "HOLD", 0.06, 307),
    # A flood of 8000 messages a second, the bus is full.
    FaultRow(6, "", "can.flood@contact+0.1s", "HOLD", 0.06, 307),
    FaultRow(7, "for 0.3 s", "can.passive@contact..contact+0.3s", "NOTE", 0.05),
    FaultRow(7, "lasting", "can.passive@contact", "HOLD", 0.5 + 2 * LOOP_S, 312),
    FaultRow(8, "bus-off", "can.off@contact+0.2s", "HOLD", 0.1, 311),
    FaultRow(8, "unplugged", "can.unplugged@contact+0.2s", "HOLD", 0.1, 311),
    # The CAN adapter is out for 50 ms; no silent reconnect, but by clear and reset.
    FaultRow(8, "back again", "can.unplugged@contact+0.1s..contact+0.15s", "HOLD", 0.1, 311),
)

CONTROL_UNIT = (
    # The unit reboots in the ramp; the limit counts its boot of 20 ms.
    FaultRow(9, "", "unit.reboot@contact+0.1s", "HOLD", BOOT_S + LOOP_S + READ_S, 308,
             changes=WIDE),
    FaultRow(10, "heartbeat lost", "unit.heartbeat_off@contact+0.1s", "HOLD", 0.25 + LOOP_S, 305),
    FaultRow(10, "never appears", "unit.off", "REJECT", START_S + 0.05, 303),
    FaultRow(10, "gone", "unit.off@contact+0.1s", "HOLD", 0.06 + SYNC_S + LOOP_S, 401),
    # Its next heartbeat says so, or the missing messages before it.
    FaultRow(11, "pre-operational", "unit.pre_operational@contact+0.1s", "HOLD", 0.1 + LOOP_S,
             (309, 401)),
    FaultRow(11, "EMCY", "unit.emergency=0x5000@contact+0.1s", "HOLD", 2 * LOOP_S, 310),
    FaultRow(12, "second unit at the start", "unit.second_node", "REJECT", START_S, 306),
    FaultRow(12, "second unit joins", "unit.second_node@contact+0.1s", "HOLD", BOOT_S + 2 * LOOP_S,
             308),
    # Two frames after each SYNC, as of a second unit that did not boot now.
    FaultRow(12, "everything twice", "can.duplicate=1@contact", "HOLD", 6 * SYNC_S, 306),
    FaultRow(12, "another unit", "unit.wrong=serial:99", "REJECT", START_S, 304,
             changes={"tactile.serial_number": 1}),
    FaultRow(12, "another layout", "unit.wrong=taxels:400", "REJECT", START_S, 304),
    FaultRow(12, "pads swapped", "unit.pads_swapped", "REJECT", START_S, 304,
             changes={"tactile.board_serial_numbers": [11, 12]}),
)

FORCES = (
    FaultRow(44, "silence", "unit.forces_off@contact+0.1s", "HOLD", FORCES_S, 401),
    FaultRow(44, "one in a hundred lost", "unit.forces_lost=0.01@contact", "NOTE", None),
    FaultRow(44, "one in four lost", "unit.forces_lost=0.25@contact+0.1s", "HOLD", 0.4, 307),
    FaultRow(44, "another table", "unit.force_gain=1.6@contact+0.3s", "HOLD", 0.5,
             changes=LONG_HOLD),
    FaultRow(44, "another table at the start", "unit.force_gain=1.6", "HOLD", 3.0, 407),
    # The frames show all the while what is held; nothing that a frame shows is let go.
    # In the ramp at 3 N, or in the hold at 6 N.
    *(FaultRow(44, f"{variant} in the {phase}",
               ", ".join(f"{text}@contact+{at_s}s{end}" for text in texts), "HOLD",
               FRAME_S + CYCLE_S, 0, at_six_newtons, LONG_HOLD)
      for phase, at_s in (("ramp", 0.35), ("hold", 1.5))
      for variant, texts, end in (
          ("zero", ("unit.force_gain=0",), ""),
          ("zero for 10 ms", ("unit.force_gain=0",), f"..contact+{at_s + 0.01:g}s"),
          ("negative", ("unit.force_gain=-1",), ""),
          ("nearly zero", ("unit.force_gain=0", "unit.force_offset=0.12"), ""),
          ("empty pads", ("unit.pads_empty",), ""))),
    FaultRow(44, "zero in a carry", "unit.force_gain=0@contact+1.2s", "HOLD", FRAME_S + CYCLE_S,
             (209, 407), carry_with_fault),
    FaultRow(44, "zero in the approach", "unit.force_gain=0@moving+0.3s", "HOLD", 2.0, 407),
    FaultRow(44, "less by 2 N in the ramp", "unit.force_offset=-2@contact+0.35s", "HOLD", 0.1, 407,
             at_six_newtons, LONG_HOLD),
    FaultRow(44, "less by a seventh", "unit.force_gain=0.86@contact+1.5s", "HOLD", 0.3, 0,
             at_six_newtons, LONG_HOLD),
    # None is missing by the counter.
    *(FaultRow(44, f"seldom, each {n}th", f"unit.forces_each={n}@contact+0.3s", "HOLD", 0.2,
               changes=LONG_HOLD)
      for n in (6, 15)),
    FaultRow(44, "late", "unit.forces_late=0.02@contact+0.3s", "HOLD", 0.2, 401, changes=LONG_HOLD),
    FaultRow(44, "late at the start", "unit.forces_late=0.02", "REJECT", START_S, 401,
             changes=PAPER_PADS),
    FaultRow(44, "centre elsewhere", "unit.centre_shift=1@contact+1.5s", "HOLD", 0.3, 0,
             at_six_newtons, LONG_HOLD),
    FaultRow(44, "no centre", "unit.centres_off@contact+1.5s", "HOLD", 0.1, 407, at_six_newtons,
             LONG_HOLD),
    FaultRow(44, "centre stuck", "object.slips=20@contact+1.5s, unit.centres_stuck@contact+1.2s",
             "HOLD", 0.3, 407, partial(grasp_with_fault, look_again=False, force_n=6.0), LONG_HOLD),
    # All taxels read nothing any more: the fingers stand, the motors press.
    *(FaultRow(44, f"blind pads, {variant}", f"taxels.gain=0@contact+{at_s}s", "HOLD", 0.5, 0,
               at_six_newtons, LONG_HOLD | changes)
      for variant, at_s, changes in (
          ("early in the ramp", 0.12, {}), ("in the ramp", 0.35, {}),
          ("in the hold", 1.5, {}),
          ("frames alone", 0.35, {"tactile.force_period_ms": 0}))),
)

TAXELS = _with(PAPER_PADS, (
    # Frozen frames: valid, new counter, same samples.
    FaultRow(13, "", "unit.stuck@contact+0.1s", "HOLD", 0.1, 401),
    FaultRow(13, "without noise", "unit.stuck@contact+0.1s", "HOLD", 0.2 + SYNC_S, 401,
             changes=NOISELESS),
    # Just after the touch the part seems soft: the same samples, or messages that contradict them.
    FaultRow(13, "without noise, at first", "unit.stuck@contact+0.04s", "HOLD", 0.3 + SYNC_S,
             (401, 407), changes=NOISELESS),
    # Four taxels of 408, or 120.
    FaultRow(14, "few at the start", "taxels.stuck=0.01", "NOTE", None),
    FaultRow(14, "many at the start", "taxels.stuck=0.3", "REJECT", START_S, 405),
    FaultRow(14, "few online", "taxels.stuck=0.01@contact+0.1s", "NOTE", SYNC_S + BURST_S + LOOP_S),
    # 120 taxels get stuck high: the force is at least what they show.
    FaultRow(14, "many online", "taxels.stuck=0.3@contact+0.1s", "HOLD", SYNC_S + BURST_S + LOWER_S,
             201),
    FaultRow(15, "few at the start", "taxels.off=0.01", "NOTE", None),
    FaultRow(15, "many at the start", "taxels.off=0.3", "REJECT", START_S, 405),
    FaultRow(15, "few online", "taxels.off=0.01@contact", "NOTE",
             STUCK_S + SYNC_S + BURST_S + LOOP_S, changes={"sequence.ramp.hold_s": 0.5}),
    FaultRow(15, "many online", "taxels.off=0.3@contact+0.1s", "HOLD",
             STUCK_S + FORCE_STALE_S + SYNC_S + BURST_S, 204, changes=LONG_HOLD),
    # A gripping pad saturates: the force is at least that of full scale, above its cap.
    FaultRow(16, "a gripping pad", "taxels.saturated=0@contact+0.1s", "HOLD",
             SYNC_S + BURST_S + LOWER_S, 201),
    FaultRow(16, "another pad", "taxels.saturated=1@contact+0.1s", "NOTE",
             SYNC_S + BURST_S + LOOP_S),
    # All taxels read 4 % more, as after a temperature step; no label is given.
    FaultRow(17, "step up in the ramp", "taxels.offset=10@contact+0.1s", "HOLD",
             FORCE_STALE_S + 2 * SYNC_S, (200, 204)),
    # All taxels read 4 % less; no label is given.
    FaultRow(17, "step down in the ramp", "taxels.offset=-10@contact+0.1s", "HOLD",
             FORCE_STALE_S + 3 * SYNC_S, 204),
    # The zero has drifted before the next grasp; it is refused with nothing moved.
    FaultRow(17, "drift between grasps", "taxels.offset=10 in a cell that waits", "HOLD", None, 0,
             campaign.drifts_between_grasps),
))

USKIN = _with(OF_USKIN, (
    FaultRow(45, "uskin board off", "uskin.off=1@contact+0.1s", "HOLD", USKIN_SILENT_S, 401),
    FaultRow(45, "uskin low supply", "uskin.low_supply=0@contact+0.1s", "HOLD", USKIN_SILENT_S,
             401),
    FaultRow(45, "uskin two boards with one address", "uskin.doubled=1@contact+0.1s", "HOLD", 0.1,
             306),
    FaultRow(45, "uskin messages lost", "can.loss=0.05@contact+0.1s", "HOLD", 0.3, (204, 401)),
    FaultRow(45, "uskin message lost", "can.lose_next=1@contact+0.1s", "NOTE", 0.03),
    # 100 counts are 0.02 N on a taxel: each approach has a zero of its own.
    FaultRow(45, "uskin drift", "uskin.drift=100", "NOTHING", None),
))

BOARDS = _with(FLEXITAC, (
    *(FaultRow(45, f"unplugged, finger {finger}", f"board.unplugged={finger}@contact+0.1s", "HOLD",
               CYCLE_S, 302)
      for finger in (0, 1)),
    FaultRow(45, "unplugged at the start", "board.unplugged=1", "REJECT", START_S, 303),
    FaultRow(45, "board off", "board.off=1@contact+0.1s", "HOLD", BOARD_SILENT_S, 401),
    FaultRow(45, "board off at the start", "board.off=0", "REJECT", START_S + 0.05, 401),
    FaultRow(45, "frozen", "board.frozen=1@contact+0.1s", "HOLD", BOARD_SILENT_S, 401),
    FaultRow(45, "repeated", "board.repeated=0.1@contact", "NOTE", None),
    FaultRow(45, "late", "board.late=0.15@contact+0.1s", "HOLD", BOARD_SILENT_S + BOARD_S, 401),
    FaultRow(45, "lost byte", "board.lost_byte=0.004", "NOTE", None),
    FaultRow(45, "lost bytes often", "board.lost_byte=0.3@contact+0.1s", "HOLD", 0.6, (204, 401),
             changes=LONG_HOLD),
    # Samples hold a header at one place for ever; later the offset is known.
    FaultRow(45, "ambiguous at the start", "board.marked=0", "REJECT", START_S + 0.05, 401),
    FaultRow(45, "header inside", "board.marked=0@contact+0.1s", "NOTHING", None),
    # The other pad's sudden force is seen, or the imbalance.
    FaultRow(45, "dead pad", "taxels.stuck_at=384-767:0@contact+0.4s", "HOLD", 0.5, (200, 207),
             changes=LONG_HOLD),
    FaultRow(45, "dead pad at the start", "taxels.stuck_at=384-767:0", "REJECT", START_S, 405),
    FaultRow(45, "saturated", "taxels.saturated=0@contact+0.1s", "HOLD",
             FORCE_STALE_S + 2 * BOARD_S, 201),
))

RH_P12 = tuple(replace(row, long=True) for row in _with(OF_RH_P12, (
    # Its only servo moves both fingers: no finger answers any more.
    FaultRow(21, "rh-p12 silent", "servo1.off@contact+0.2s", "HOLD", BUS_LOST_S, 102),
    FaultRow(26, "rh-p12 direction", "servo1.turned", "REJECT", VERIFY_S, 110),
    *(FaultRow(27, f"rh-p12 drift to {side}", f"servo1.drift={speed}@contact+0.2s", "HOLD", DRIFT_S,
               202, changes=LONG_HOLD)
      for side, speed in (("open", 0.3), ("closed", -0.3))),
    # Before its first self-zero it presses with 0.7 N: the pads show a loss by five empty frames,
    # and a slide by a larger way.
    *(FaultRow(28, f"rh-p12 part lost in {where}", f"object.gone@contact+{after_s}s", "PART LOST",
               0.15, 0, campaign.part_leaves, LONG_HOLD)
      for where, after_s in (("the ramp", 0.3), ("a hold", 1.5))),
    FaultRow(28, "rh-p12 part slips", "object.slips=20@contact+1.5s", "HOLD", 0.45, 206,
             partial(grasp_with_fault, look_again=False), LONG_HOLD),
    # Its bus watchdog trips and the motor turns on; the self-test is on.
    FaultRow(30, "rh-p12", "servo1.watchdog_off", "REJECT", 3.0, 113,
             changes={"gripper.watchdog_self_test": True}),
)))

SERVO_BUS = (
    FaultRow(18, "one lost answer", "servos.loss=1@contact+0.2s..contact+205ms", "NOTE", CYCLE_S),
    FaultRow(18, "one lost request", "servos.lost_requests=1@contact+0.2s..contact+205ms", "NOTE",
             CYCLE_S),
    FaultRow(18, "now and then", "servos.loss=0.05", "NOTE", None),
    # Three answers in twenty are lost: above the share that is allowed.
    FaultRow(18, "often", "servos.loss=0.15@contact+0.2s", "HOLD", LOSSY_S, 106, changes=LONG_HOLD),
    FaultRow(19, "cable out", "servos.unplugged@contact+0.2s", "HOLD", BUS_LOST_S, 101),
    # The cable is out for 0.2 s; no silent reconnect, but by clear and reset.
    FaultRow(19, "cable back", "servos.unplugged@contact+0.2s..contact+0.4s", "HOLD", BUS_LOST_S,
             101),
    FaultRow(19, "dead bus", "servos.off@contact+0.2s", "HOLD", BUS_LOST_S, 102),
    FaultRow(19, "all answers late", "servos.delayed=0.03@contact+0.2s", "HOLD", BUS_LOST_S, 102),
    FaultRow(19, "answers come again", "servos.repeated=9.5ms@contact+0.2s", "HOLD", BUS_LOST_S,
             105),
    FaultRow(19, "answers lag by one", "servos.lagging@contact+0.2s", "HOLD", BUS_LOST_S, 105),
    # The same with bus_loss_ms 500: a lag that lasts is never accepted.
    FaultRow(19, "answers lag and patience", "servos.lagging@contact+0.2s", "HOLD",
             0.5 + 4 * LOOP_S, 105, changes=LONG_HOLD | {"gripper.bus_loss_ms": 500.0}),
    # The bus is lost, or the one servo whose answers the bytes meet.
    FaultRow(20, "chatter", "servos.chatter=0.7ms@contact+0.2s", "HOLD", LOSSY_S, (106, 103),
             changes=LONG_HOLD | PAPER_PADS | WIDE),
    FaultRow(20, "bit errors", "servos.corrupt=1@contact+0.2s..contact+0.21s", "NOTE", CYCLE_S),
    FaultRow(20, "cut answers", "servos.truncated=1@contact+0.2s", "HOLD", BUS_LOST_S, 105),
    FaultRow(20, "wrong sender", "servos.wrong_id=1@contact+0.2s..contact+205ms", "NOTE", CYCLE_S),
    FaultRow(20, "noise before answers", "servos.garbage=1", "NOTE", None),
    FaultRow(20, "own echo", "servos.echo", "NOTE", None),
    FaultRow(21, "second finger in the ramp", "servo2.off@contact+0.2s", "HOLD", ONE_SILENT_S, 103),
    FaultRow(21, "in the approach", "servo2.off@moving+0.6s", "HOLD", ONE_SILENT_S, 103,
             changes=WIDE),
)

SERVOS = (
    # Somebody changes a register in a hold; one is read every 60 ms.
    FaultRow(26, "while running", "servo2.wrong=shutdown:0@contact+0.3s", "HOLD", VERIFY_AGAIN_S,
             109, changes=LONG_HOLD),
    FaultRow(22, "overload", "servo1.overload@contact+0.2s", "ABORT", CYCLE_S, 109),
    FaultRow(22, "electrical shock", "servo2.error=16@contact+0.2s", "ABORT", CYCLE_S, 109),
    # A servo is warmer than temperature_max_c, below its own limit.
    FaultRow(23, "hot", "servo1.overheat=74@contact+0.1s", "HOLD", 1.0, 200,
             changes={"sequence.ramp.rate_n_s": 5.0}),
    FaultRow(23, "latched", "servo1.overheat=90@contact+0.2s", "ABORT", CYCLE_S, (109, 200)),
    FaultRow(24, "dip", "servo2.supply=9@contact+0.2s", "HOLD", CYCLE_S, 109),
    # The supply dips for 50 ms and the servo restarts; silent while it boots.
    FaultRow(24, "brown-out",
             "servo2.reboot@contact+0.2s, servo2.supply=5@contact+0.2s..contact+0.25s", "ABORT",
             ONE_SILENT_S, 103),
    # A servo restarts in the ramp: it is silent while it boots, so three periods are waited.
    FaultRow(25, "", "servo1.reboot@contact+0.2s", "ABORT", ONE_SILENT_S, 103),
    *(FaultRow(26, variant, f"servo2.wrong={register}", "REJECT", VERIFY_S)
      for variant, register in (
          ("id", "id:7"), ("baud rate", "baud_rate:1"), ("model", "model_number:1060"),
          ("current limit", "current_limit:100"), ("drive mode", "drive_mode:1"),
          ("homing offset", "homing_offset:500"), ("shutdown", "shutdown:0"),
          ("second id", "secondary_id:1"))),
    FaultRow(26, "direction of both", "servo1.turned, servo2.turned", "REJECT", VERIFY_S, 110),
    FaultRow(26, "direction of one", "servo2.turned", "REJECT", VERIFY_S, 110),
    # The horns sit 40 degrees off, towards closed.
    FaultRow(26, "zero far off", "servo1.horn=-452, servo2.horn=-452", "REJECT", VERIFY_S, 110),
    # The same towards open: the fingers meet on their way to the opening.
    FaultRow(26, "zero far off to open", "servo1.horn=452, servo2.horn=452", "REJECT", VERIFY_S,
             114, changes=EQUAL),
    # The horns sit 9 degrees off: closed fingers do not find each other.
    FaultRow(26, "zero off", "servo1.horn=-100, servo2.horn=-100", "LIMP", None, 114, changes=WIDE),
    FaultRow(27, "encoder jump", "servo1.jump=0.3@contact+0.2s", "LIMP", CYCLE_S, 112),
    FaultRow(27, "out of range", "servo2.jump=1.5@contact+0.2s", "LIMP", CYCLE_S, 112),
    FaultRow(27, "off by a turn", "servo1.turn@contact+0.5s", "LIMP", CYCLE_S, 112),
    # A servo reports another turn than it goes by: it leaves its place with the torque.
    FaultRow(27, "off by a turn at the start", "servo1.turn", "REJECT", 0.2 + STANDING_S, 112),
    FaultRow(27, "drift to open", "servo1.drift=0.3@contact+0.2s", "HOLD", DRIFT_S, 202,
             changes=LONG_HOLD),
    FaultRow(27, "drift to closed", "servo1.drift=-0.3@contact+0.2s", "HOLD", DRIFT_S, 202,
             changes=LONG_HOLD),
    # A position stands still while the empty finger moves; its motor shows it.
    FaultRow(27, "stuck encoder", "servo1.stuck@moving+0.05s", "HOLD", DRIFT_S, 202, changes=WIDE),
    # The bus watchdog of a servo trips and the motor turns on; the self-test is on.
    FaultRow(30, "", "servo2.watchdog_off", "REJECT", 3.0, 113,
             changes={"gripper.watchdog_self_test": True}),
)

GRIP = (
    # The part is taken away in the approach: the fingers close to their limit.
    FaultRow(28, "no part", "object.gone@moving+0.6s", "NO PART FOUND", 1.5, 0,
             campaign.part_leaves, WIDE),
    # A slip: 2 mm of way, and the mean of the sensor; 50 ms would be 1 mm, its noise.
    *(FaultRow(28, f"{variant} at {rate_n_s:g} N/s", f"{injected}@contact+{at_s}s", reaction,
               limit_s, number, scenario, LONG_HOLD | {"sequence.ramp.rate_n_s": rate_n_s})
      for rate_n_s, ramp_s, hold_s in ((10.0, 0.3, 1.5), (20.0, 0.1, 1.0), (40.0, 0.1, 1.0))
      for variant, injected, at_s, reaction, limit_s, scenario, number in (
          ("part lost in the ramp", "object.gone", ramp_s, "PART LOST", 0.03,
           campaign.part_leaves, 0),
          ("part lost in a hold", "object.gone", hold_s, "PART LOST", 0.025,
           campaign.part_leaves, 0),
          ("part slips", "object.slips=20", hold_s, "HOLD", 0.2,
           partial(grasp_with_fault, look_again=False), 206))),
    *(FaultRow(kind, f"{variant} in a carry", f"{injected}@contact+1.2s", reaction, limit_s, number,
               carry_with_fault, long=kind != 28)
      for kind, variant, injected, reaction, limit_s, number in (
          (1, "one set lost", "can.lose_next=6", "NOTE", None, 0),
          (8, "unplugged", "can.unplugged", "HOLD", 0.1, 311),
          (18, "one lost answer", "servos.lose_next=1", "NOTE", None, 0),
          (19, "cable out", "servos.unplugged", "HOLD", BUS_LOST_S, 101),
          (21, "second finger", "servo2.off", "HOLD", ONE_SILENT_S, 103),
          (25, "restart", "servo1.reboot", "ABORT", ONE_SILENT_S, 103),
          (28, "part lost", "object.gone", "HOLD", 0.08, 205),
          (28, "part slips", "object.slips=20", "HOLD", 0.2, 206))),
    # Something trapped pushes the force above its cap in a hold; time counts from the cap.
    FaultRow(29, "too much force", "object.trapped=5@contact+1s", "HOLD", LOWER_S, 0,
             campaign.something_pushes,
             LONG_HOLD | {"sequence.force_n": [2.0, 4.0], "gripper.force_max_n": campaign.CAP_N}),
    # A config asks for an approach whose impact is far above the cap; it is slowed down.
    FaultRow(29, "approach of 200 mm per s", "gripper.approach_speed_mm_s=200", "NOTHING", None, 0,
             campaign.fast_approach,
             {"gripper.approach_speed_mm_s": 200.0, "gripper.force_max_n": 8.0,
              "gripper.aperture_open_mm": 18.0, "gripper.linkage.link_mm": 30.0,
              "sequence.force_n": [2.0, 4.0], "tactile.force_period_ms": 0}),
    # Valid configs with fast, strong or late fingers.
    FaultRow(29, "random configs", "12 configs that are drawn", "NOTHING", None, 0,
             campaign.random_configs, long=True),
)

HOST_PROGRAM = (
    FaultRow(31, "stall", "a sink that sleeps for 500 ms", "HOLD", 0.5 + 2 * LOOP_S, 0,
             partial(campaign.loop_held_up, stall_s=0.5)),
    # Each period takes 10 ms too long; so many in a row are the limit.
    FaultRow(31, "overruns in a row", "a sink that sleeps, each time", "HOLD",
             (OVERRUNS_MAX + 2) * (0.010 + LOOP_S), 0,
             partial(campaign.loop_held_up, stall_s=0.010, times=1000)),
    # What collects the periods of the loop raises; the host's callback that moves the robot.
    FaultRow(32, "sink", "an exception", "HOLD", LOOP_S, 0, campaign.error_in_the_loop),
    FaultRow(32, "mover", "an exception", "HOLD", LOOP_S, 0, campaign.error_in_the_mover),
    # A host program ends by an error of its own mid-job and closes nothing.
    FaultRow(33, "uncaught error", "an exception in the main thread, real time", "HOLD", SIGNAL_S,
             0, campaign.host_ends_by_an_error, real_time=True),
    # The wall clock jumps in the ramp.
    *(FaultRow(40, variant, f"{step_s:+g} s", "NOTHING", None, 0,
               partial(campaign.wall_clock_jumps, step_s=step_s))
      for variant, step_s in (
          ("an hour on", HOUR_S), ("an hour back", -HOUR_S), ("NTP step", -0.4))),
)

AXES = (
    *(FaultRow(43, variant, text, "HOLD", limit_s, number, campaign.axis_fails, long=True)
      for variant, text, limit_s, number in (
          ("drive fault", "axis1.fault=0x2310", AXIS_S, 606),
          ("lost heartbeat", "axis1.silence", HEARTBEAT_S, 604),
          ("following error", "axis2.following_error", FOLLOWING_S, 606),
          ("wrist stalled", "axis3.following_error", STALL_S, 606),
          ("wrist silent", "axis3.silence", WRIST_LOST_S, 604))),
)
# fmt: on

GROUPS = {
    "CAN bus": CAN_BUS,
    "control unit": CONTROL_UNIT,
    "force messages": FORCES,
    "taxels": TAXELS,
    "sensor boards": BOARDS + USKIN,
    "servo bus": SERVO_BUS,
    "servos": SERVOS,
    "RH-P12-RN(A) with FlexiTac": RH_P12,
    "grip": GRIP,
    "host program": HOST_PROGRAM,
    "axes": AXES,
}
"""The rows by what fails."""

ROWS: tuple[FaultRow, ...] = tuple(
    sorted((row for rows in GROUPS.values() for row in rows), key=lambda r: (r.row, r.variant))
)
"""All rows, in the order of the page."""

EACH_CHANGE: tuple[FaultRow, ...] = tuple(
    {
        (group, row.reaction, row.reaction != "NOTE" and (row.number or row.row)): row
        for group, rows in GROUPS.items()
        for row in reversed(rows)
        if not (row.long or row.real_time)
    }.values()
)
"""The rows of each change: of each group the first note, and the first of each reaction with its
number, or without one with its kind. The others are long: other tests have their detectors."""
