"""Positions that cannot be: off by a turn, or another count than the servo goes by."""

import pytest

from gripper.dynamixel.control_table import TORQUE_ENABLE
from gripper.errors import FeedbackImplausible, fingers_left
from gripper.force.ramp import ForceRamp
from gripper.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


@pytest.mark.parametrize("turns", [1, -1, 3])
@pytest.mark.parametrize("index", [0, 1])
def test_a_count_that_leaps_by_a_turn_moves_no_finger(cell, index, turns) -> None:
    cell.hold_part(RAMP)
    due_s = cell.clock.monotonic() + 0.3
    leapt: list[tuple[float, int, float]] = []

    def leap(cycle) -> None:
        if not leapt and cycle.t_s >= due_s:
            cell.knobs[index].offset_report(4096 * turns)
            goal_raw = cell.servos[index].core.registers.get("goal_position")
            leapt.append((cell.clock.monotonic(), goal_raw, cell.mechanics.aperture_m))

    with pytest.raises(
        FeedbackImplausible, match=f"servo {index + 1}: .* off by .* turns"
    ) as error:
        cell.gripper.hold(2.0, leap)
    then_s, goal_raw, aperture_m = leapt[0]
    assert cell.clock.monotonic() - then_s < 0.008
    assert cell.servos[index].core.registers.get("goal_position") == goal_raw
    assert cell.torques == [0, 0]
    assert fingers_left(error.value).startswith("the fingers have no torque any more; a part may")
    assert "the pads measured" in fingers_left(error.value)
    cell.clock.sleep(1.0)
    assert cell.mechanics.aperture_m == pytest.approx(aperture_m, abs=0.002)


def test_a_leap_in_a_pause_is_found_before_the_next_goal(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.keep_grip()
    cell.clock.sleep(2.0)
    goal_raw = cell.register(0, "goal_position")
    cell.knobs[0].offset_report(4096)
    with pytest.raises(FeedbackImplausible, match="off by"):
        cell.gripper.release()
    assert cell.register(0, "goal_position") == goal_raw
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT


def test_turns_of_a_servo_without_torque_do_not_matter(cell) -> None:
    cell.gripper.start()
    before_m = cell.gripper.read_state().aperture_m
    cell.knobs[0].offset_report(2 * 4096)
    assert cell.gripper.read_state().aperture_m == pytest.approx(before_m, abs=1e-4)


def test_a_servo_that_goes_by_another_count_than_it_reports_is_made_limp_at_once(cell) -> None:
    cell.knobs[1].offset_report(4096)
    cell.gripper.start()
    before_m = cell.mechanics.aperture_m
    with pytest.raises(FeedbackImplausible, match=r"servo 2: it has moved by .* is its goal"):
        cell.gripper.open()
    assert cell.torques == [0, 0]
    cell.clock.sleep(1.0)
    assert abs(cell.mechanics.aperture_m - before_m) < 0.004


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
