"""Goals that make a driving force: their side, and how far they may open."""

from dataclasses import replace

import pytest

from gripper.force.control.drive_goals import GIVE_RAD, DriveGoals
from gripper.mechanics.kinematics import transmissions
from gripper.settings import GripperSettings
from gripper.values.state import ServoFeedback
from tests.gripper.force.grips import LINKAGE, STATE, make_grip

SETTINGS = GripperSettings()


def standing(angle_rad: float) -> ServoFeedback:
    servos = tuple(replace(one, angle_rad=angle_rad) for one in STATE.servos)
    return replace(STATE, servos=servos, aperture_m=LINKAGE.aperture_m((angle_rad,) * 2))


def first_goal(goals: DriveGoals, drive_n: float, angle_rad: float) -> tuple[float, float]:
    state = standing(angle_rad)
    goals._grip.drive_n = drive_n
    made = goals.goals(state, transmissions(SETTINGS, LINKAGE, state.angles_rad))
    return made[0].angle_rad, made[0].current_a


def test_the_side_of_the_goal_is_the_sign_of_the_drive() -> None:
    contact = standing(0.1)
    goals = DriveGoals(make_grip(), contact, contact.aperture_m)
    closing_rad, closing_a = first_goal(goals, 4.0, 0.09)
    opening_rad, opening_a = first_goal(goals, -4.0, 0.09)
    assert closing_rad < 0.09 < opening_rad
    assert closing_a == pytest.approx(opening_a)
    assert first_goal(goals, 100.0, 0.09)[1] == SETTINGS.current_max_a


def test_a_position_that_drifts_open_does_not_take_a_closing_goal_with_it() -> None:
    goals = DriveGoals(make_grip(), standing(0.1), standing(0.1).aperture_m)
    before_rad, _ = first_goal(goals, 4.0, 0.09)
    assert first_goal(goals, 4.0, 0.2)[0] == pytest.approx(before_rad, abs=1e-3)


def test_no_finger_is_driven_open_beyond_the_touch() -> None:
    contact = standing(0.1)
    touch_m = standing(0.1 + 0.5 * GIVE_RAD).aperture_m
    goals = DriveGoals(make_grip(), contact, touch_m)
    assert first_goal(goals, -30.0, 0.1)[0] == pytest.approx(0.1 + GIVE_RAD)
    assert goals.may_open
    beyond_rad = 0.1 + 0.6 * GIVE_RAD
    assert first_goal(goals, -30.0, beyond_rad)[0] == pytest.approx(beyond_rad)
    assert not goals.may_open
    first_goal(goals, -30.0, 0.1)
    assert goals.may_open
