"""Fingers: statics against the motor's figures, stiction, stability, end stops, recorded motion."""

import math

import pytest
from hypothesis import given, settings, strategies as st

from gripper.dynamixel.models import XL330_M288, XM430_W350
from simulator.servo.gearing import GEARINGS, IDEAL_GEARING, XM430_W350_GEARING, Gearing
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, RackLinkage, ServoMount
from simulator.servo.motor import DriveCommand, DriveMode, ServoMotor

STEP_S = 1e-3
MOUNTS = (ServoMount(direction=1), ServoMount(direction=-1))


def fingers(
    count=2, *, model=XM430_W350, linkage=None, aperture_m=0.04, gearing=IDEAL_GEARING, **options
):
    return FingerMechanics(
        [ServoMotor(model, gearing=gearing) for _ in range(count)],
        MOUNTS[:count],
        linkage or ParallelogramLinkage(link_m=0.06),
        aperture_m=aperture_m,
        **options,
    )


def push(mechanics: FingerMechanics, closing_a: float) -> None:
    """Let every motor close with a current in A."""
    for motor, mount in zip(mechanics.motors, MOUNTS, strict=False):
        motor.drive(DriveCommand(DriveMode.CURRENT, current_a=-mount.direction * closing_a))


def press(mechanics, wall_m, stiffness_n_m, duration_s, dt_s=STEP_S, *, implicit=True):
    """Press both fingers on springs that begin at a half opening; return the last forces in N."""
    force = (0.0, 0.0)
    for _ in range(round(duration_s / dt_s)):
        depths = [max(0.0, wall_m - x) for x in mechanics.finger_position_m]
        force = (stiffness_n_m * depths[0], stiffness_n_m * depths[1])
        felt = tuple(stiffness_n_m if d > 0.0 else 0.0 for d in depths)
        mechanics.step(dt_s, force, felt if implicit else (0.0, 0.0))
    return force


@pytest.mark.parametrize("linkage", [ParallelogramLinkage(offset_m=0.005), RackLinkage()])
@given(half_m=st.floats(0.0, 0.045))
@settings(max_examples=40)
def test_linkages_invert_and_differentiate(linkage, half_m: float):
    angle = linkage.angle_rad(half_m)
    assert linkage.half_opening_m(angle) == pytest.approx(half_m, abs=1e-12)
    slope = (linkage.half_opening_m(angle + 1e-6) - linkage.half_opening_m(angle - 1e-6)) / 2e-6
    assert linkage.slope_m_rad(angle) == pytest.approx(slope, rel=1e-5)
    assert linkage.half_opening_m(angle) < linkage.half_opening_max_m


def test_start_positions_and_directions():
    mechanics = fingers(aperture_m=0.04)
    theta = math.asin(0.02 / 0.06)
    first, second = mechanics.motors
    assert first.angle_rad == pytest.approx(2048 * XM430_W350.rad_per_pulse + theta)
    assert second.angle_rad == pytest.approx(2048 * XM430_W350.rad_per_pulse - theta)
    assert mechanics.finger_position_m == pytest.approx((0.02, 0.02))
    assert mechanics.aperture_m == pytest.approx(0.04)


@pytest.mark.parametrize("count", [1, 2])
def test_closing_current_gives_the_force_of_the_torque_fit(count: int):
    mechanics = fingers(count)
    push(mechanics, 0.6)
    force = press(mechanics, 0.015, 20_000.0, 2.0)
    slope = 0.06 * math.cos(math.asin(0.0148 / 0.06))
    expected_n = (1.769 * 0.6 - 0.2214) / slope * (0.5 if count == 1 else 1.0)
    # Inertia presses a little deeper before the friction locks, in the band of twice the friction.
    band_n = 2.1 * 0.2214 / slope
    assert expected_n - 0.2 <= force[0] <= expected_n + band_n
    assert force[0] == pytest.approx(force[1], rel=0.02)


def held_n(mechanics, current_a: float, before_a: float) -> float:
    """Return the force on a soft spring after the current went slowly from another one."""
    for i in range(1, 401):
        push(mechanics, before_a + (current_a - before_a) * i / 400)
        force = press(mechanics, 0.0195, 3_000.0, 5 * STEP_S)
    return force[0]


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_unloading_holds_more_by_twice_the_friction_and_that_of_the_load(share: float):
    mechanics = fingers(gearing=Gearing(load_friction=share))

    loading_n = held_n(mechanics, 0.5, 0.0)
    held_n(mechanics, 1.0, 0.5)
    unloading_n = held_n(mechanics, 0.5, 1.0)
    slope = 0.06 * math.cos(math.asin(0.0165 / 0.06))
    assert loading_n == pytest.approx((1.769 * 0.5 - 0.2214) / slope, rel=0.06)
    most_n = (1.0 + share) / (1.0 - share) * (1.769 * 0.5 + 0.2214) / slope
    assert unloading_n - loading_n == pytest.approx(most_n - loading_n, rel=0.12)


@pytest.mark.parametrize("name", [n for n, g in GEARINGS.items() if g.identified is not None])
def test_a_real_gearing_presses_and_holds_as_its_law_says(name: str):
    mechanics = fingers(gearing=GEARINGS[name])
    drive = GEARINGS[name].drive_of(XM430_W350)

    slope = 0.06 * math.cos(math.asin(0.016 / 0.06))
    rising_nm = slope * held_n(mechanics, 1.0, 0.0)
    forward_nm = drive.friction.forward_nm(drive.kt_nm_a, 0.0)
    # Friction that fades with speed makes steps of the motion: each ends a little farther.
    assert rising_nm == pytest.approx(forward_nm, rel=0.1)
    # The load gives way where it overcomes the motor and the friction of both.
    giving_nm = slope * held_n(mechanics, 0.15, 1.0)
    driving_nm = 0.15 * drive.kt_nm_a
    lost_nm = drive.friction.torque_nm(driving_nm, -giving_nm, 0.0)
    assert giving_nm == pytest.approx(driving_nm + lost_nm, rel=0.2)
    assert giving_nm > 1.5 * driving_nm


def test_below_the_friction_band_nothing_moves():
    mechanics = fingers()
    before = mechanics.finger_position_m
    push(mechanics, 0.13)
    press(mechanics, 0.0, 0.0, 1.0)
    assert mechanics.finger_position_m == before
    push(mechanics, 0.15)
    press(mechanics, 0.0, 0.0, 0.2)
    assert mechanics.aperture_m < 0.04


@pytest.mark.parametrize(
    ("model", "linkage", "stiffness_n_m", "implicit"),
    [
        (XM430_W350, ParallelogramLinkage(), 500.0, True),
        (XM430_W350, ParallelogramLinkage(), 50_000.0, False),
        (XM430_W350, RackLinkage(), 5_000.0, False),
        (XL330_M288, ParallelogramLinkage(), 5_000.0, True),
        (XL330_M288, RackLinkage(), 500.0, False),
        (XL330_M288, RackLinkage(), 50_000.0, True),
    ],
)
def test_contact_comes_to_rest_at_any_stiffness(model, linkage, stiffness_n_m, implicit):
    mechanics = fingers(model=model, linkage=linkage)
    push(mechanics, 0.5)
    press(mechanics, 0.018, stiffness_n_m, 3.0, implicit=implicit)
    assert [motor.velocity_rad_s for motor in mechanics.motors] == [0.0, 0.0]
    assert all(x < 0.018 for x in mechanics.finger_position_m)


def test_long_steps_are_taken_in_pieces():
    fine, coarse = fingers(), fingers()
    for mechanics, dt_s in ((fine, STEP_S), (coarse, 5 * STEP_S)):
        push(mechanics, 0.6)
        press(mechanics, 0.015, 5_000.0, 1.0, dt_s)
    assert coarse.aperture_m == pytest.approx(fine.aperture_m, abs=3e-4)


def test_end_stops_hold_the_fingers():
    mechanics = fingers(half_opening_min_m=0.002)
    push(mechanics, 0.5)
    press(mechanics, 0.0, 0.0, 1.0)
    assert mechanics.finger_position_m == pytest.approx((0.002, 0.002), abs=1e-9)
    push(mechanics, -0.5)
    press(mechanics, 0.0, 0.0, 1.0)
    widest_m = ParallelogramLinkage(link_m=0.06).half_opening_max_m
    assert mechanics.finger_position_m == pytest.approx((widest_m, widest_m), abs=1e-9)


def test_without_torque_friction_alone_holds_a_light_load():
    mechanics = fingers()
    mechanics.step(STEP_S, (3.0, 3.0))
    assert mechanics.aperture_m == pytest.approx(0.04)
    for _ in range(100):
        mechanics.step(STEP_S, (8.0, 8.0))
    assert mechanics.aperture_m > 0.04
    assert all(motor.velocity_rad_s != 0.0 for motor in mechanics.motors)


def test_a_light_force_moves_a_finger_through_the_backlash_and_no_further():
    backlash_rad = math.radians(0.25)
    mechanics = fingers(gearing=Gearing(backlash_rad=backlash_rad, output_friction=0.1))
    slope = 0.06 * math.cos(math.asin(0.02 / 0.06))
    way_m = slope * backlash_rad
    for _ in range(100):
        mechanics.step(STEP_S, (1.0, 1.0))
    # At the start the teeth stand in the middle.
    assert mechanics.aperture_m - 0.04 == pytest.approx(way_m, rel=0.02)
    stood_m = mechanics.aperture_m
    push(mechanics, -0.3)
    motor = mechanics.motors[0]
    while motor.lead_rad < 0.4 * backlash_rad:
        mechanics.step(STEP_S, (0.0, 0.0))
        assert mechanics.aperture_m == pytest.approx(stood_m, abs=5e-6)
    assert motor.rotor_velocity_rad_s > 0.1
    press(mechanics, 0.0, 0.0, 0.05)
    assert mechanics.aperture_m > stood_m + way_m


@pytest.mark.parametrize("stiffness_n_m", [500.0, 5_000.0, 50_000.0])
def test_contact_comes_to_rest_with_all_that_a_gearing_does(stiffness_n_m: float):
    mechanics = fingers(gearing=XM430_W350_GEARING)
    push(mechanics, 0.5)
    press(mechanics, 0.018, stiffness_n_m, 3.0)
    held = mechanics.finger_position_m
    force_n = press(mechanics, 0.018, stiffness_n_m, 1.0)
    assert mechanics.finger_position_m == held
    assert min(force_n) > 5.0


def test_a_record_moves_the_fingers_exactly():
    mechanics = fingers()
    push(mechanics, 0.5)
    for aperture_m in (0.03, 0.025, 0.0251):
        mechanics.drive_to(aperture_m)
        mechanics.step(STEP_S, (5.0, 5.0))
        assert mechanics.aperture_m == pytest.approx(aperture_m, abs=1e-12)
    mechanics.drive_to(-5e-5)  # as of pads that press on each other
    assert mechanics.aperture_m == pytest.approx(0.0, abs=1e-4)
    press(mechanics, 0.0, 0.0, 0.05)
    assert mechanics.motors[0].current_a == pytest.approx(-0.5, abs=0.01)
