"""What each kind of fault does to torque and goals: hold, stand still, open a step, go limp."""

import random
import re
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import copysign
from typing import Any

import pytest

from gripper import errors
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import REGISTERS, TORQUE_ENABLE
from gripper.dynamixel.models import XL330_M288, XM430_W350
from gripper.force.ramp import ForceRamp
from gripper.gripper import Gripper
from gripper.servos import feedback
from gripper.values.state import GripperPhase
from simulator.servo.faults import Chatter, WireFaults
from tests.marks import LONG
from tests.values import raising

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


def test_a_current_that_cannot_be_keeps_what_the_pads_hold(cell, monkeypatch) -> None:
    cell.hold_part(RAMP)

    def absurd(model, present_a: float, *_of: float) -> tuple[float, float]:
        return 12.0 * present_a, 12.0 * present_a

    observe = cell.once(lambda: monkeypatch.setattr(feedback, "winding_a", absurd), in_s=0.3)
    with pytest.raises(errors.GripContradicted, match=r"at most 1\.50 A are .* the grip kept"):
        cell.gripper.hold(2.0, observe)
    assert cell.torques == [1, 1]
    assert cell.force_n > 3.5
    cell.gripper.clear_fault()
    with pytest.raises(errors.ServoFault, match=r"its free motion takes 0\.\d+ A"):
        cell.gripper.release()
    assert cell.force_n == 0.0


@pytest.mark.parametrize("silent", [(), (2,)])
@pytest.mark.parametrize("lost", [0.0, 0.25])
def test_force_that_one_pad_shows_alone_lowers_the_currents(make_cell, lost, silent) -> None:
    cell = make_cell(force_max_n=6.0)
    cell.hold_part(RAMP)
    written: list[int] = []
    measure, cell.device.faults.drop = cell.sensor.measure, lost
    cell.sensor.measure = lambda now_s, true_n: measure(now_s, (2.5 * true_n[0], true_n[1]))

    def observe(_: object) -> None:
        written.append(cell.register(0, "goal_current"))
        if len(written) == 6:  # one before the force counts as too high
            cell.device.faults.silent.update(silent)

    with pytest.raises(errors.ForceAboveCap, match="force_max_n is 6"):
        cell.gripper.hold(1.0, observe)
    cell.clock.sleep(0.5)
    assert 0.4 * abs(written[-1]) < abs(cell.register(0, "goal_current")) < abs(written[-1])
    assert (1.5 if silent else 3.0) < cell.force_n < 4.4


def test_the_other_finger_stands_still_when_a_servo_drops_its_torque(cell) -> None:
    cell.hold_part(RAMP)
    with pytest.raises(errors.ServoFault, match="overload") as fault:
        cell.gripper.hold(2.0, cell.once(cell.servos[1].plant.overload, in_s=0.5))
    assert fault.value.torque_lost
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.02
    # The goal is where the finger was, not beyond: it pushes nothing ahead of itself.
    goal, present = cell.register(0, "goal_position"), cell.register(0, "present_position")
    assert abs(goal - present) < 12
    living_m = cell.mechanics.finger_position_m[0]
    cell.part.present = False
    cell.clock.sleep(1.0)
    assert abs(cell.mechanics.finger_position_m[0] - living_m) < 0.0008


def test_a_torque_that_is_lost_between_two_commands_is_a_fault_of_the_next_one(cell) -> None:
    cell.hold_part(RAMP)
    cell.servos[1].write(64, b"\0", cell.clock.monotonic())
    with pytest.raises(errors.ServoFault, match="torque is off although") as fault:
        cell.gripper.hold(2.0)
    assert (fault.value.torque_lost, cell.torques) == (True, [1, 0])
    # Without torque the gearing alone may hold the part: no motion of empty fingers follows.
    cell.servos[0].write(64, b"\0", cell.clock.monotonic())
    cell.gripper.clear_fault()
    cell.gripper.start()
    with pytest.raises(errors.GripperStateError, match="release the part first"):
        cell.gripper.open()
    assert cell.gripper.release().opened == (1, 2)


# Fingers on their way stop where they are.


class Fails(Exception):
    """What an observer may raise."""


def deaf(cell) -> None:
    cell.gripper.request_stop()
    cell.gripper.bus.sync_write = lambda *_a, **_k: None


SEEN = "were seen last"
IN_THE_WAY: dict[str, tuple[Callable[[Any], object], type[Exception], str]] = {
    "stop": (lambda cell: cell.gripper.request_stop(), errors.GraspStopped, "stopped"),
    "fail": (lambda _cell: raising(Fails("the disk is full"))(), Fails, "stopped"),
    "stall": (lambda cell: cell.clock.sleep(0.3), errors.LimitExceeded, "stopped"),
    "silent": (lambda cell: cell.device.faults.silent.add(1), errors.FingerSilent, SEEN),
    "deaf": (deaf, errors.ServoFault, SEEN),
    "dead": (lambda cell: cell.device.faults.silent.update((1, 2)), errors.BusTimeout, SEEN),
}
"""What happens while the fingers open fast, its error, and the state of the fingers in its note."""


@pytest.mark.parametrize("how", IN_THE_WAY)
@pytest.mark.parametrize("command", ["release", "open"])
def test_fingers_on_their_way_stop_where_they_are(make_cell, command, how) -> None:
    cell, (act, error, left) = make_cell(aperture_open_m=0.04), IN_THE_WAY[how]
    if command == "release":
        cell.hold_part(RAMP)
    else:
        cell.gripper.start()

    def observe(cycle) -> None:
        if cycle.phase.moving and cycle.state.aperture_velocity_m_s > 0.03:
            act(cell)

    with pytest.raises(error) as caught:
        getattr(cell.gripper, command)(observer=observe)
    told = errors.fingers_left(caught.value)
    other = Fails("x")
    errors.copy_fingers(caught.value, other)
    errors.copy_fingers(caught.value, other)
    assert other.__notes__ == [told]
    doing = "letting go" if command == "release" else "opening"
    assert told.startswith(f"the fingers {left} while {doing}, at an opening of ")
    assert ("may still touch" in told) == (command == "release")
    assert ("watchdog" in told) == (left != "stopped")
    if left != "stopped":
        cell.gripper.keep_grip()
        cell.gripper.close()
    cell.clock.sleep(0.25)
    stood_m = cell.mechanics.aperture_m
    assert stood_m < 0.036
    with suppress(errors.BusTimeout):
        cell.gripper.keep_grip()
    cell.clock.sleep(2.0)
    assert cell.mechanics.aperture_m == pytest.approx(stood_m, abs=3e-4)
    if how in {"stop", "fail"}:
        assert float(re.findall(r"([\d.]+) mm", told)[0]) == pytest.approx(stood_m * 1e3, abs=1.0)
    if how == "stop":
        expected = GripperPhase.HELD_AFTER_FAULT if command == "release" else GripperPhase.IDLE
        assert cell.gripper.phase is expected
        getattr(cell.gripper, command)()
        assert cell.mechanics.aperture_m == pytest.approx(0.04, abs=1e-3)


def test_a_finger_next_to_a_silent_servo_follows_no_error_of_its_encoder(make_started) -> None:
    cell = make_started(aperture_m=0.03)
    with pytest.raises(errors.FingerSilent):
        cell.gripper.grasp(RAMP, cell.once(lambda: cell.device.faults.silent.add(1), in_s=0.2))
    stood_m = cell.mechanics.finger_position_m[1]
    cell.motors[1].encoder_offset_rad = 0.3
    cell.clock.sleep(0.5)
    assert cell.mechanics.finger_position_m[1] == pytest.approx(stood_m, abs=5e-4)


def test_silent_servos_do_not_hold_up_the_report_of_another_fault(make_started) -> None:
    """A supply that fails takes pads and servos at once; the pads are named first."""
    cell = make_started(bus_loss_s=0.5)

    def fail() -> None:
        cell.sensor.dead = True
        cell.device.faults.silent.update({1, 2})

    with pytest.raises(errors.ForceSensorStale):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=3.0))
    asked_s = cell.clock.monotonic()
    with pytest.raises(errors.BusTimeout):
        cell.gripper.keep_grip()
    assert cell.clock.monotonic() - asked_s < 0.02


@pytest.mark.parametrize("command", [Gripper.tick, partial(Gripper.hold, duration_s=0.5)])
def test_a_watchdog_that_trips_behind_the_last_look_at_it_is_found(cell, command) -> None:
    cell.hold_part(RAMP)
    cell.clock.sleep(1.0)
    cell.peak_n = cell.force_n
    cell.gripper._servos._finds_trip = lambda: False
    with pytest.raises(errors.ServoFault, match="the loop fell silent"):
        [command(cell.gripper) for _ in range(4)]
    cell.clock.sleep(0.5)
    assert 1.4 < cell.force_n <= cell.peak_n < 4.5


def test_goals_that_freeze_after_messages_of_empty_pads_keep_the_force(make_started) -> None:
    cell = make_started(rate_hz=200.0, noise_n=0.05, stiffness_n_m=2000.0)
    cell.gripper.grasp(ForceRamp.linear(6.0, rate_n_s=20.0, hold_s=0.1))
    cell.gripper.hold_at(6.0)
    held_n, cell.sensor.gain = cell.force_n, 0.0
    for _ in range(4):
        cell.clock.sleep(cell.settings.period_s)
        cell.gripper.tick()
    cell.gripper.keep_grip()
    cell.clock.sleep(0.5)
    assert cell.force_n > 0.8 * held_n


def test_fingers_that_stand_at_the_end_of_the_time_are_not_taken_for_empty(make_started) -> None:
    """Pads that are nearly blind, and a time that ends before the fingers count as stalled."""
    cell = make_started(rate_hz=200.0, noise_n=0.02, contact_timeout_s=1.0)
    cell.sensor.gain = 0.03
    with pytest.raises(errors.GripContradicted, match=r"pads show|empty pads"):
        cell.gripper.grasp(RAMP)
    assert cell.force_n > 0.5


def test_a_stuck_finger_is_reported(started) -> None:
    started.gripper.open(0.025)
    for motor in started.motors:
        motor.friction_factor = 50.0
    with pytest.raises(errors.FingerBlocked, match=r"stuck.*gripper.linkage"):
        started.gripper.open()
    started.gripper.clear_fault()
    assert started.gripper.phase is GripperPhase.HELD_AFTER_FAULT


def test_a_finger_that_opens_while_its_reported_position_drifts_closes_at_no_stop(started) -> None:
    started.gripper.open(0.013)
    servo, begin_s = started.servos[0], started.clock.monotonic()

    def drift(now_s: float) -> None:
        servo.reported_offset_raw = round(-0.5 * (now_s - begin_s) / servo.model.rad_per_pulse)

    started.clock.on_advance.append(drift)
    with pytest.raises(errors.PositionContradicted, match="servo 1"):
        started.gripper.release()
    stopped_rad = started.motors[0].angle_rad
    started.clock.sleep(0.5)
    assert started.motors[0].angle_rad == pytest.approx(stopped_rad, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [*range(3), *(LONG(seed) for seed in range(3, 200))])
def test_the_force_stays_below_its_cap_with_a_wrong_encoder_at_any_moment(make_cell, seed) -> None:
    """In an approach, a ramp, a hold or a release, of a part or a self-zero, and after it."""
    draw = random.Random(seed)
    kind, cap_n = ("stuck", "jumps", "drifts")[seed % 3], draw.choice((5.0, 15.0, 30.0))
    value = draw.choice((-1.0, 1.0)) * draw.choice((0.02, 0.05, 0.2, 0.5, 1.5))
    kinds: list[dict[str, Any]] = [{}, {}, {"rate_hz": None}, {"n_servos": 1, "linkage": "rack"}]
    cell = make_cell(
        force_max_n=cap_n,
        aperture_m=0.03,
        width_m=draw.choice((0.012, 0.0)),
        **{"rate_hz": 200.0, "noise_n": 0.1} | draw.choice(kinds),
    )
    gripper, ramp = cell.gripper, ForceRamp.linear(0.6 * cap_n, rate_n_s=10.0, hold_s=0.3)
    close = gripper.grasp if cell.part.width_m else gripper.press_pads_together
    gripper.start()
    begin_s, motor = cell.clock.monotonic() + draw.uniform(0.0, 2.5), draw.choice(cell.motors)

    def disturb(now_s: float) -> None:
        if now_s >= begin_s and kind != "stuck":
            motor.encoder_offset_rad = value * (now_s - begin_s if kind == "drifts" else 1.0)
        elif now_s >= begin_s and motor.stuck_at_rad is None:
            motor.stuck_at_rad = motor.angle_rad

    cell.clock.on_advance.append(disturb)
    closing, again = partial(close, ramp), partial(gripper.grasp, ramp)
    hold = partial(gripper.hold, 0.3)
    for command in (closing, hold, gripper.clear_fault, gripper.release, again):
        with suppress(errors.GripperError, ValueError):
            command()
    cell.clock.sleep(0.5)
    assert cell.peak_n <= cap_n


@pytest.mark.slow
@pytest.mark.parametrize(
    ("at_n", "rate_hz"), [(0.5, None), (4.0, 200.0), LONG(2.0, None), LONG(2.0, 200.0)]
)
def test_currents_that_freeze_in_a_grip_let_no_part_go(
    make_started, monkeypatch, at_n, rate_hz
) -> None:
    """Else the control lowers the drive until the pads are empty, and reports the part as lost."""
    cell = make_started(rate_hz=rate_hz, stiffness_n_m=5000.0)

    def frozen(_model, present_a: float, *_of: float) -> tuple[float, float]:
        return copysign(0.25, present_a), copysign(0.25, present_a)

    observe = cell.once(lambda: monkeypatch.setattr(feedback, "winding_a", frozen), at_n=at_n)
    with suppress(errors.PositionContradicted):
        cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.5), observe)
        cell.gripper.hold(1.0)
        cell.gripper.hold_at(2.0, 1.0)
    assert cell.force_n > 0.9 * min(at_n, 2.0)


# -- The start: who is there, what the servos are set to, and whether the link keeps up ------------


PING_BYTES = 14
"""Answer to a ping: Model Number and Firmware Version in a status packet."""
SENTENCE = b"$GPGGA,092751.000,5321.6802,N,00630.3371,W,1,8,1.03,61.7,M\r\n"
PATTERNS = {
    "dense": Chatter(data=b"\xa5", every_s=0.0003),
    "40 bytes each 10 ms": Chatter(data=bytes(range(0x80, 0xA8)), every_s=0.01),
    "a sentence each 30 ms": Chatter(data=SENTENCE, every_s=0.03),
}


def test_a_servo_with_another_id_is_named_in_the_table(cell) -> None:
    cell.servos[1].registers.data[7] = 5
    with pytest.raises(
        errors.VerificationFailed, match=r"other IDs that answer: 5 \(XM430-W350\)"
    ) as bad:
        cell.gripper.start()
    (row,) = bad.value.report.failed
    assert (row.servo_id, row.item, row.expected) == (2, "ping", "an answer at 1000000 baud")
    assert "or name the right one in gripper.servos[].id" in str(bad.value)
    assert not cell.servos[0].torque_on


@pytest.mark.parametrize("pattern", PATTERNS.values(), ids=PATTERNS)
def test_a_start_on_a_line_of_another_device_names_what_was_heard(cell, pattern) -> None:
    cell.device.faults.silent.update({1, 2})
    cell.device.faults.chatter = pattern
    with pytest.raises(errors.BusCorrupt, match=r"the servo line did not become quiet.* no packet"):
        cell.gripper.start()
    assert cell.clock.monotonic() < 2.0


@pytest.mark.parametrize(("name", "raw"), [("min_voltage_limit", 60), ("pwm_limit", 100)])
def test_a_changed_eeprom_register_is_shown_expected_against_found(cell, name, raw) -> None:
    for servo in cell.servos:
        servo.registers.put(name, raw)
    with pytest.raises(errors.VerificationFailed, match=rf"servo 2 {name}.*found {raw}") as bad:
        cell.gripper.start()
    failed = [(row.servo_id, row.item, row.actual) for row in bad.value.report.failed]
    assert failed == [(1, name, str(raw)), (2, name, str(raw))]
    assert cell.torques == [0, 0]


@pytest.mark.parametrize("raw", [253, 254, 255])
def test_a_second_id_that_no_servo_listens_to_is_none(cell, raw: int) -> None:
    cell.servos[1].registers.put("secondary_id", raw)
    assert cell.gripper.start().ok


@pytest.mark.parametrize("echo", [False, True])
def test_what_does_not_answer_gets_a_hint(cell, echo: bool) -> None:
    """With an echo the host receives what it sends, and nothing else."""
    cell.device.baudrate, cell.device.faults.echo = 57600, echo
    before_s = cell.clock.monotonic()
    with pytest.raises(errors.VerificationFailed, match=r"gripper\.baud_rate and gri"):
        cell.gripper.start()
    assert cell.clock.monotonic() - before_s < 2.0


@pytest.mark.parametrize("level", [0, 1])
def test_servos_that_confirm_no_write_are_told_to_before_anything_else(cell, level: int) -> None:
    for servo in cell.servos:
        servo.registers.put("status_return_level", level)
    assert cell.gripper.start().ok
    assert cell.register(1, "status_return_level") == 2


@pytest.mark.parametrize("model", [XM430_W350, XL330_M288])
def test_gains_and_slope_that_the_goals_count_on_are_put_right(make_cell, model) -> None:
    cell = make_cell(model=model, current_max_a=0.35)
    wanted = dict(zip(("d", "i", "p"), model.position_gains, strict=True))
    registers = {f"position_{name}_gain": gain for name, gain in wanted.items()}
    if model is XL330_M288:
        registers["pwm_slope"] = 140
    for name, raw in registers.items():
        cell.bus.write(1, REGISTERS[name], raw + 7)
    report = cell.gripper.start()
    assert {name: cell.register(0, name) for name in registers} == registers
    rewritten = {row.item for row in report.rows if row.corrected and row.servo_id == 1}
    assert rewritten >= {"operating_mode"} | ({*registers} & {"pwm_slope"})


def test_an_overload_that_is_only_reported_is_a_note_and_keeps_the_grip(cell) -> None:
    for servo in cell.servos:
        servo.registers.put("shutdown", 20)
    cell.hold_part(ForceRamp.linear(2.0, rate_n_s=5.0))
    cell.gripper.hold(0.5, cell.once(cell.servos[0].plant.overload, in_s=0.1))
    assert cell.gripper.phase is GripperPhase.HOLDING
    (note,) = cell.gripper.read_drives().notes
    assert note == (
        "servo 1: an overload is only reported: the cell's limit of heat alone protects it"
    )


@pytest.mark.parametrize(
    ("delay_s", "remedy"),
    [(0.016, r"latency timer.*raise the baud rate\. Nothing"), (0.004, r"loop_rate_hz to 1\d\d\.")],
)
def test_an_adapter_with_much_latency_is_refused_with_the_remedy(cell, delay_s, remedy) -> None:
    cell.device.faults.delay_s = delay_s
    with pytest.raises(errors.LinkTooSlow, match=remedy):
        cell.gripper.start()


def test_a_latency_of_2_ms_only_makes_the_time_outs_longer(cell) -> None:
    cell.device.faults.delay_s = 0.002
    cell.hold_part(ForceRamp.linear(4.0, rate_n_s=5.0))
    assert cell.gripper.statistics.missed_reads == 0


@pytest.mark.parametrize("how", ["late", "lost"])
def test_a_machine_that_is_too_busy_is_refused(cell, how) -> None:
    class Busy(WireFaults):
        answers = 0

        def answer(self, servo_id: int, packet: bytes) -> list[tuple[float, bytes]]:
            """Return each third answer to a ping late, or not at all."""
            self.answers += len(packet) == PING_BYTES
            third = self.answers % 3 == 0 and len(packet) == PING_BYTES
            self.delay_s = 0.003 if third and how == "late" else 0.0
            return [] if third and how == "lost" else super().answer(servo_id, packet)

    cell.device.faults = Busy()
    with pytest.raises(errors.LinkTooSlow, match="too busy"):
        cell.gripper.start()


# -- Letting go on purpose: with whatever servos still answer, and only ever opening ---------------


def leave_part(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.close()


def held_by_one(cell, limp: int = 0):
    """Hold the part, let a servo shut down, and return the gripper of the next program."""
    leave_part(cell)
    cell.servos[limp].plant.overload()
    cell.clock.sleep(0.1)
    assert cell.register(limp, "torque_enable") == 0
    return cell.new_gripper()


@pytest.mark.parametrize("limp", [0, 1])
def test_the_other_finger_opens_where_a_servo_has_shut_down(cell, limp) -> None:
    gripper = held_by_one(cell, limp)
    assert cell.force_n > 1.0
    before_m = cell.mechanics.finger_position_m
    report = gripper.release()
    assert cell.force_n == 0.0
    assert report.opened == (2 - limp,)
    assert [c.servo_id for c in report.left] == [limp + 1]
    assert f"servo {limp + 1} has no torque (overload)" in str(report)
    assert "with a reboot" in str(report)
    after_m = cell.mechanics.finger_position_m
    assert after_m[1 - limp] == pytest.approx(0.015, abs=0.001)
    # The limp finger gives way to the elastic part, and is not moved by more.
    assert abs(after_m[limp] - before_m[limp]) < 0.001
    assert cell.torques == [0, 0]
    assert gripper.phase is GripperPhase.OFF
    gripper.clear_fault(reboot=True)
    assert gripper.start().ok
    gripper.open()
    assert cell.mechanics.finger_position_m[limp] == pytest.approx(0.015, abs=0.001)


@pytest.mark.parametrize("lost", ["answer", "request"])
def test_a_reboot_is_judged_by_the_servo_not_by_its_answer(cell, monkeypatch, lost) -> None:
    gripper = held_by_one(cell)
    gripper.release()
    reboot = ServoBus.reboot

    def without(bus: ServoBus, servo_id: int) -> None:
        if lost == "answer":
            reboot(bus, servo_id)
        raise errors.BusTimeout("reboot: no answer")

    monkeypatch.setattr(ServoBus, "reboot", without)
    if lost == "request":
        with pytest.raises(errors.ServoFault, match="lasts after a reboot"):
            gripper.clear_fault(reboot=True)
        return
    gripper.clear_fault(reboot=True)
    assert gripper.start().ok


@pytest.mark.parametrize("level", [0, 1])
def test_a_servo_that_does_not_confirm_is_named_with_its_register(cell, level) -> None:
    cell.servos[1].registers.put("status_return_level", level)
    with pytest.raises(
        errors.AnswersOff, match=r"servo 2, although it answers pings: .*\(register 68\)"
    ):
        cell.bus.write(2, TORQUE_ENABLE, 0)
    assert str(cell.gripper.conditions()[1]) == (
        "servo 2 has no torque"
        if level
        else "servo 2 answers pings only: its Status Return Level (register 68) is 0; a start or a "
        "release sets it to 2"
    )


@pytest.mark.parametrize("levels", [(0, 0), (1, 2)])
def test_a_part_is_let_go_by_servos_that_confirm_no_write(cell, levels) -> None:
    leave_part(cell)
    for servo, level in zip(cell.servos, levels, strict=True):
        servo.registers.put("status_return_level", level)
    assert cell.new_gripper().release().opened == (1, 2)
    assert cell.force_n == 0.0


@pytest.mark.parametrize("how", ["torque 0", "reboot", "low supply"])
def test_a_servo_that_is_limp_or_has_an_error_with_torque_opens_again(cell, how) -> None:
    leave_part(cell)
    if how == "torque 0":
        cell.bus.write(1, TORQUE_ENABLE, 0)
    elif how == "reboot":
        cell.servos[0].boot(cell.clock.monotonic())
    else:
        cell.servos[0].plant.voltage_v = 9.0
    cell.clock.sleep(1.0)
    assert cell.torques == [how == "low supply", 1]
    report = cell.new_gripper().release()
    assert (report.opened, report.left) == ((1, 2), ())
    assert str(report) == "the fingers are open"
    assert cell.force_n == 0.0
    assert report.state.aperture_m == pytest.approx(0.03, abs=0.001)


def test_the_finger_that_answers_opens_where_the_other_is_silent(cell) -> None:
    leave_part(cell)
    cell.device.faults.silent.add(1)
    report = cell.new_gripper().release()
    assert cell.force_n == 0.0
    assert report.opened == (2,)
    assert "servo 1 does not answer" in str(report)
    assert "may still have its torque" in str(report)


def test_a_started_gripper_lets_go_after_a_clear_too(cell) -> None:
    cell.hold_part(RAMP)
    with pytest.raises(errors.ServoFault) as fault:
        cell.gripper.hold(1.0, lambda _: cell.bus.write(1, TORQUE_ENABLE, 0))
    assert "may still be gripped (the pads measured" in errors.fingers_left(fault.value)
    cell.gripper.clear_fault()
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    for _ in range(8):
        cell.gripper.tick()
    assert cell.gripper.release().opened == (1, 2)
    assert cell.force_n == 0.0
    assert cell.gripper.phase is GripperPhase.IDLE


def test_nothing_is_opened_where_no_servo_can_be_moved_and_the_way_on_is_named(make_cell) -> None:
    cell = make_cell(n_servos=1, linkage="rack")
    held_by_one(cell)
    with pytest.raises(
        errors.ServoFault, match=r"no finger can be opened: servo 1 has no torque .*hand"
    ):
        cell.new_gripper().release()
    cell.device.faults.silent.add(1)
    with pytest.raises(errors.BusTimeout, match="check supply"):
        cell.new_gripper().release()


def test_a_servo_that_does_not_match_is_made_limp_and_the_message_says_so(cell) -> None:
    leave_part(cell)
    cell.servos[1].registers.put("drive_mode", 1)
    with pytest.raises(
        errors.VerificationFailed, match="torque is off now and the fingers did not open"
    ):
        cell.new_gripper().release()
    assert cell.torques == [0, 0]


def test_a_release_of_one_finger_can_be_stopped_and_ended_later(make_cell) -> None:
    cell = make_cell(aperture_open_m=0.04)
    gripper = held_by_one(cell)

    def stop(cycle) -> None:
        if cycle.state.aperture_m > 0.02:
            gripper.request_stop()

    with pytest.raises(errors.GraspStopped) as stopped:
        gripper.release(stop)
    assert "stopped while letting go" in errors.fingers_left(stopped.value)
    assert gripper.fault is None
    assert gripper.phase is GripperPhase.HELD_AFTER_FAULT
    gripper.keep_grip()
    stood_m = cell.mechanics.finger_position_m[1]
    assert stood_m < 0.015
    cell.clock.sleep(1.0)
    assert cell.mechanics.finger_position_m[1] == pytest.approx(stood_m, abs=3e-4)
    assert cell.torques == [0, 1]
    assert gripper.release().opened == (2,)
    assert cell.mechanics.finger_position_m[1] == pytest.approx(0.02, abs=0.001)


def test_a_fault_while_one_finger_opens_is_that_of_the_gripper(make_cell) -> None:
    cell = make_cell(aperture_open_m=0.04)
    gripper = held_by_one(cell)

    def observe(cycle) -> None:
        assert gripper.phase is GripperPhase.RELEASING
        if cycle.state.aperture_velocity_m_s > 0.01:
            gripper.request_stop()
            cell.bus.sync_write = lambda *_a, **_k: None

    with pytest.raises(errors.ServoFault, match="did not take the goal to stand still") as caught:
        gripper.release(observe)
    assert gripper.fault is caught.value
    assert gripper.phase is GripperPhase.HELD_AFTER_FAULT
    gripper.keep_grip()
    assert cell.register(1, "bus_watchdog") == 10, "it alone stops the finger"


@pytest.mark.parametrize("lost", [0, 2])
def test_a_finger_whose_position_has_leapt_is_not_said_to_be_open(cell, lost) -> None:
    cell.hold_part(RAMP)
    bus, fails = cell.gripper.bus, [raising(errors.BusTimeout("lost"))] * lost
    write = bus.write
    bus.write = lambda *of: (fails.pop() if fails and of[1] is TORQUE_ENABLE else write)(*of)
    cell.servos[0].plant.encoder_offset_rad += 0.3
    with pytest.raises(errors.FeedbackImplausible, match="leapt"):
        cell.gripper.hold(1.0)
    cell.gripper.clear_fault()
    report = cell.gripper.release()
    assert report.opened == (2,)
    left = "the finger of servo 2 is open, the other one was not moved: servo 1 has no torque, and "
    assert str(report).startswith(f"{left}where its finger is, is unknown")
    assert cell.torques == [0, 0]
    with pytest.raises(errors.FeedbackImplausible, match=r"leapt .* not restarted since then"):
        cell.gripper.start()
    cell.servos[0].plant.encoder_offset_rad += -0.3
    cell.gripper.clear_fault(reboot=True)
    cell.gripper.start()
    assert cell.gripper.open().aperture_m == pytest.approx(0.03, abs=0.001)
    assert str(cell.gripper.release()) == "the fingers are open"


def test_a_finger_that_is_said_to_stand_too_wide_open_is_named(started) -> None:
    started.gripper.open()
    started.gripper.close()
    started.servos[0].plant.encoder_offset_rad += 0.3
    started.clock.sleep(2.0)
    report = started.gripper.release()
    assert report.wider == (1,)
    assert "the finger of servo 1 was not moved" in str(report)
    assert "zero_pulse of the servo, and gripper.linkage" in str(report)
