"""The table of transitions: which mode makes the drive, and what ends it."""

from dataclasses import replace

import pytest

from gripper.force.control.band_mode import BandMode
from gripper.force.control.modes import TRANSITIONS, GripModes, TrialMode, WaitMode
from gripper.force.control.motion_mode import MotionMode
from gripper.force.control.period import Period
from gripper.mechanics.kinematics import driving_n
from gripper.values.force_sensor import ForceSample
from tests.gripper.force.grips import make_grip, make_period

STEADY = {"setpoint_n": 2.0, "sample": 2.0}
RISES = {"setpoint_n": 2.1, "sample": 2.0, "rises_n": 0.1}
CREEPS = {"setpoint_n": 2.01, "sample": 2.0, "rises_n": 0.01}
FALLS = {"setpoint_n": 1.9, "sample": 2.0, "rises_n": -0.1}
NOTHING = {"setpoint_n": 2.0, "sample": None}
BY_CURRENT = ForceSample(t_s=0.005, force_n=(2.0, 2.0), lag_s=0.0, by_current=True)


def period(now_s: float, given: dict) -> Period:
    return make_period(now_s, **given)


def new_modes(*, doubt_n: float = 0.0) -> GripModes:
    return GripModes(make_grip(2.0, start_doubt_n=doubt_n), 0.0, pad_n_m=1e4)


@pytest.mark.parametrize(
    ("periods", "modes"),
    [
        ((STEADY, RISES, RISES), (BandMode, MotionMode, MotionMode)),
        ((CREEPS, CREEPS), (MotionMode, MotionMode)),
        ((CREEPS | {"dt_s": 0.0},), (BandMode,)),
        ((RISES | {"sample": BY_CURRENT},), (BandMode,)),
        ((RISES, FALLS, RISES), (MotionMode, BandMode, MotionMode)),
        ((RISES, NOTHING, NOTHING, RISES), (MotionMode, WaitMode, WaitMode, MotionMode)),
        ((STEADY, NOTHING, STEADY), (BandMode, WaitMode, BandMode)),
        ((RISES, RISES | {"dt_s": 0.013}), (MotionMode, BandMode)),
        ((RISES | {"dt_s": 0.013},), (BandMode,)),
    ],
)
def test_the_mode_follows_the_table(periods, modes) -> None:
    grip_modes = new_modes()
    for i, (given, expected) in enumerate(zip(periods, modes, strict=True)):
        drive_n = grip_modes.step(period(0.005 * (i + 1), given))
        assert type(grip_modes.active) is expected
        grip_modes.grip.drive_n = drive_n


@pytest.mark.parametrize(
    ("setpoint_n", "doubt_n", "now_s", "may_open", "moves"),
    [
        (2.2, 0.01, 0.1, True, True),
        (1.8, 0.01, 0.1, True, True),
        (1.8, 0.01, 0.1, False, False),  # the fingers may not open any farther
        (2.2, 0.01, 0.04, True, False),  # too soon after the contact
        (2.2, 0.16, 0.1, True, False),  # the force is not known well enough
        (2.04, 0.01, 0.1, True, False),  # small enough to be left alone
        (1.93, 0.01, 0.1, True, False),
    ],
)
def test_an_error_of_a_hold_is_made_up_for_by_a_motion(
    setpoint_n, doubt_n, now_s, may_open, moves
) -> None:
    modes = new_modes(doubt_n=doubt_n)
    modes.step(make_period(now_s, setpoint_n, 2.0, may_open=may_open))
    assert (type(modes.active) is MotionMode) is moves


@pytest.mark.parametrize(("falling_share", "mode"), [(1.0, BandMode), (0.5, MotionMode)])
def test_old_samples_plan_a_motion_only_where_the_gearing_sticks(falling_share, mode) -> None:
    frame = ForceSample(t_s=0.005, force_n=(2.0, 2.0), lag_s=0.045)
    paths = make_period(0.005, 2.1).paths
    drives = [
        replace(path.drive, falling_a_nm=falling_share * path.drive.rising_a_nm) for path in paths
    ]
    changed = tuple(path._replace(drive=one) for path, one in zip(paths, drives, strict=True))
    modes = new_modes()
    modes.step(make_period(0.005, 2.1, frame, rises_n=0.1, paths=changed))
    assert type(modes.active) is mode


def test_a_wait_takes_the_crest_of_the_square_wave_off_the_drive() -> None:
    modes = new_modes()
    modes.grip.drive_n, modes.grip.quiet_n = 5.4, 5.0
    assert modes.step(period(0.005, NOTHING)) == 5.0


def test_where_one_finger_is_measured_the_drive_is_a_limit_and_goes_on_from_there() -> None:
    modes = new_modes()
    modes.grip.moving = 0
    measured = period(0.005, STEADY)
    assert modes.step(measured) == measured.drive_max_n
    assert isinstance(modes.active, TrialMode)
    assert modes.grip.quiet_n == pytest.approx(driving_n(measured.state, measured.paths))
    modes.grip.moving = None
    assert modes.step(period(0.01, STEADY)) < measured.drive_max_n
    assert isinstance(modes.active, BandMode)


def test_each_mode_can_be_entered_and_left() -> None:
    kinds = {BandMode, MotionMode, TrialMode, WaitMode}
    assert {source for source, _, _ in TRANSITIONS} == kinds
    assert {target for _, _, target in TRANSITIONS} == kinds
