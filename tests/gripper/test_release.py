"""Letting go on purpose: with whatever servos still answer, and only ever opening."""

import pytest

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import TORQUE_ENABLE
from gripper.errors import (
    BusTimeout,
    FeedbackImplausible,
    GraspStopped,
    ServoFault,
    VerificationFailed,
    fingers_left,
)
from gripper.force.ramp import ForceRamp
from gripper.values.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


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
        raise BusTimeout("reboot: no answer")

    monkeypatch.setattr(ServoBus, "reboot", without)
    if lost == "request":
        with pytest.raises(ServoFault, match="lasts after a reboot"):
            gripper.clear_fault(reboot=True)
        return
    gripper.clear_fault(reboot=True)
    assert gripper.start().ok


@pytest.mark.parametrize("levels", [(0, 0), (1, 1), (2, 0), (1, 2)])
def test_a_part_is_let_go_by_servos_that_confirm_no_write(make_cell, levels) -> None:
    cell = make_cell(corrected_registers=frozenset({"operating_mode", "return_delay_time"}))
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
    with pytest.raises(ServoFault) as fault:
        cell.gripper.hold(1.0, lambda _: cell.bus.write(1, TORQUE_ENABLE, 0))
    assert "may still be gripped (the pads measured" in fingers_left(fault.value)
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
    with pytest.raises(ServoFault, match=r"no finger can be opened: servo 1 has no torque .*hand"):
        cell.new_gripper().release()
    cell.device.faults.silent.add(1)
    with pytest.raises(BusTimeout, match="check supply"):
        cell.new_gripper().release()


def test_a_servo_that_does_not_match_is_made_limp_and_the_message_says_so(cell) -> None:
    leave_part(cell)
    cell.servos[1].registers.put("drive_mode", 1)
    with pytest.raises(VerificationFailed, match="torque is off now and the fingers did not open"):
        cell.new_gripper().release()
    assert cell.torques == [0, 0]


def test_a_release_of_one_finger_can_be_stopped_and_ended_later(make_cell) -> None:
    cell = make_cell(aperture_open_m=0.04)
    gripper = held_by_one(cell)

    def stop(cycle) -> None:
        if cycle.state.aperture_m > 0.02:
            gripper.request_stop()

    with pytest.raises(GraspStopped) as stopped:
        gripper.release(stop)
    assert "stopped while letting go" in fingers_left(stopped.value)
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


def test_a_release_closes_no_finger_that_stands_wide_open(make_started) -> None:
    cell = make_started(aperture_m=0.07, aperture_open_m=0.018, force_max_n=9.0, present=False)
    assert cell.gripper.release().state.aperture_m == pytest.approx(0.07, abs=0.002)
    cell.clock.sleep(0.5)
    assert cell.mechanics.aperture_m == pytest.approx(0.07, abs=0.002)
    assert cell.gripper.open().aperture_m == pytest.approx(0.018, abs=0.001)


def test_a_finger_whose_position_has_leapt_is_not_said_to_be_open(cell) -> None:
    cell.hold_part(RAMP)
    cell.servos[0].plant.encoder_offset_rad += 0.3
    with pytest.raises(FeedbackImplausible, match="leapt"):
        cell.gripper.hold(1.0)
    cell.gripper.clear_fault()
    report = cell.gripper.release()
    assert report.opened == (2,)
    assert "servo 1 has no torque, and where its finger is, is unknown" in str(report)
    assert cell.torques == [0, 0]
    with pytest.raises(FeedbackImplausible, match=r"leapt .* not restarted since then"):
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
