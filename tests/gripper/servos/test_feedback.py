"""Positions that cannot be: off by a turn, or another count than the servo goes by."""

import pytest

from gripper.dynamixel.control_table import TORQUE_ENABLE
from gripper.errors import FeedbackImplausible, ServoFault
from gripper.force.ramp import ForceRamp
from gripper.values.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


def test_a_leap_in_a_pause_is_found_before_the_next_goal(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.keep_grip()
    cell.clock.sleep(2.0)
    goal_raw = cell.register(0, "goal_position")
    cell.knobs[0].offset_report(4096)
    with pytest.raises(FeedbackImplausible, match="off by"):
        cell.gripper.release()
    assert cell.register(0, "goal_position") == goal_raw
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT


def test_turns_of_a_servo_without_torque_do_not_matter(started) -> None:
    before_m = started.gripper.read_feedback().aperture_m
    started.knobs[0].offset_report(2 * 4096)
    assert started.gripper.read_feedback().aperture_m == pytest.approx(before_m, abs=1e-4)


@pytest.mark.parametrize("offset_raw", [-4096, 800])
def test_no_goal_is_made_of_a_position_far_from_the_one_in_force(cell, offset_raw) -> None:
    cell.hold_part(RAMP)
    cell.gripper.close()
    cell.knobs[0].offset_report(offset_raw)
    goal_raw = cell.register(0, "goal_position")
    with pytest.raises(FeedbackImplausible, match=r"servo 1: .* holds the goal .* rad away"):
        cell.new_gripper().release()
    assert cell.register(0, "goal_position") == goal_raw
    assert cell.bus.read(1, TORQUE_ENABLE) == 0


@pytest.mark.parametrize("servo", [0, 1])
def test_a_servo_that_has_restarted_between_two_readings_is_a_fault_at_once(cell, servo) -> None:
    """No silence tells of it, only its tick; a goal would move the other finger alone."""
    cell.hold_part(RAMP)
    cell.gripper.hold(0.5)
    core = cell.servos[servo].core
    restart = cell.once(lambda: core.boot(cell.clock.monotonic(), blackout_s=0.0), in_s=0.2)
    goals_s: list[float] = []

    def observe(cycle) -> None:
        goals_s.append(cycle.t_s)
        restart(cycle)

    with pytest.raises(ServoFault, match="its torque is off although") as error:
        cell.gripper.hold(2.0, observe)
    assert (error.value.servo_id, error.value.torque_lost) == (servo + 1, True)
    assert goals_s[-1] <= cell.acted_s[0]
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.015
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    cell.clock.sleep(1.0)
    assert cell.torques == [servo, 1 - servo]
