"""The friction law against its formula, by hand, and gearings behind motors of other models."""

import math
from itertools import pairwise

import pytest

from gripper.dynamixel.models import XL330_M288, XM430_W350
from simulator.servo.gearing import GEARINGS, MX_64_GEARING, MX_106_GEARING, Drive, Friction

IDENTIFIED = [name for name, gearing in GEARINGS.items() if gearing.identified is not None]
LAW = Friction(
    base_nm=(0.1, 0.05),
    drive=(0.3, 0.1),
    load=(0.02, 0.2),
    drive_quadratic_per_nm=0.01,
    load_quadratic_per_nm=0.005,
    stribeck_rad_s=2.0,
    stribeck_exponent=2.0,
    viscous_nm_s=0.03,
)


def figures(name: str) -> Drive:
    return GEARINGS[name].identified


@pytest.mark.parametrize(
    ("driving_nm", "load_nm", "speed_rad_s", "friction_nm"),
    [
        (0.0, 0.0, 0.0, 0.15),
        (0.0, 0.0, 2.0, 0.1 + 0.05 * math.exp(-1.0)),
        # At rest: 0.15 + |0.02 Te - 0.3 Tm| + |0.2 Te - 0.1 Tm| + q of the weaker one.
        (2.0, -1.0, 0.0, 0.15 + 0.62 + 0.4 + 0.005),
        (1.0, -2.0, 0.0, 0.15 + 0.34 + 0.5 + 0.01),
        (-1.0, 2.0, 0.0, 0.15 + 0.34 + 0.5 + 0.01),
        # Both in one direction: the shares work against each other, and there is no square.
        (1.0, 1.0, 0.0, 0.15 + 0.28 + 0.1),
        (2.0, -1.0, 1e3, 0.1 + 0.62),
    ],
)
def test_the_law_is_its_formula(driving_nm, load_nm, speed_rad_s, friction_nm) -> None:
    assert LAW.torque_nm(driving_nm, load_nm, speed_rad_s) == pytest.approx(friction_nm)
    more_nm = LAW.torque_nm(driving_nm, load_nm, speed_rad_s, base_factor=3.0)
    bare_nm = 0.1 + 0.05 * LAW.fading(speed_rad_s)
    assert more_nm - friction_nm == pytest.approx(2.0 * bare_nm)


@pytest.mark.parametrize("friction", [LAW, *(figures(name).friction for name in IDENTIFIED)])
@pytest.mark.parametrize("speed_rad_s", [0.0, 0.3, 3.0])
def test_what_drives_forward_is_the_motor_less_its_friction(friction, speed_rad_s) -> None:
    driving_nm = 1.5
    forward_nm = friction.forward_nm(driving_nm, speed_rad_s)
    lost_nm = friction.torque_nm(driving_nm, -forward_nm, speed_rad_s)
    lost_nm += friction.viscous_nm_s * speed_rad_s
    assert 0.0 < forward_nm == pytest.approx(driving_nm - lost_nm)
    assert friction.forward_nm(0.0, speed_rad_s) == 0.0


@pytest.mark.parametrize("name", IDENTIFIED)
def test_scaled_torques_have_scaled_friction(name) -> None:
    friction = figures(name).friction
    torques_nm = [-0.8, -0.1, 0.0, 0.2, 1.3]
    for driving_nm, load_nm in [(a, b) for a in torques_nm for b in torques_nm]:
        alone_nm = friction.torque_nm(driving_nm, load_nm, 0.4)
        twice_nm = friction.scaled(2.0).torque_nm(2.0 * driving_nm, 2.0 * load_nm, 0.4)
        assert twice_nm == pytest.approx(2.0 * alone_nm)


@pytest.mark.parametrize("name", IDENTIFIED)
def test_friction_fades_with_speed(name) -> None:
    friction = figures(name).friction
    found_nm = [friction.torque_nm(0.6, -0.4, 0.05 * step) for step in range(100)]
    assert all(after <= before for before, after in pairwise(found_nm))


def test_behind_another_motor_the_drive_meets_the_graph_in_its_middle() -> None:
    current_a, speed_rad_s = 0.5 * 2.3, 0.5 * XM430_W350.no_load_rad_s
    for name in IDENTIFIED:
        drive = GEARINGS[name].drive_of(XM430_W350)
        made_nm = drive.friction.forward_nm(drive.kt_nm_a * current_a, speed_rad_s)
        assert made_nm == pytest.approx(1.769 * current_a - 0.2214)
        factor = drive.kt_nm_a / figures(name).kt_nm_a
        assert drive.inertia_kg_m2 == pytest.approx(factor * figures(name).inertia_kg_m2)
        assert drive.back_emf_v_s == drive.kt_nm_a
    for gearing in (MX_64_GEARING, MX_106_GEARING):
        drive = gearing.drive_of(XM430_W350)
        slow_nm = drive.friction.forward_nm(drive.kt_nm_a * current_a, 0.0)
        assert 0.7 < slow_nm / (1.769 * current_a - 0.2214) < 0.8


def test_a_servo_of_the_identified_model_has_its_figures() -> None:
    assert GEARINGS["xl330"].drive_of(XL330_M288) is GEARINGS["xl330"].identified
    # At 0.4 A a quarter less than the catalogue says.
    drive = GEARINGS["xl330"].drive_of(XL330_M288)
    catalogue_nm = XL330_M288.kt_nm_a * 0.4 - XL330_M288.friction_nm
    forward_nm = drive.friction.forward_nm(drive.kt_nm_a * 0.4, 0.0)
    assert forward_nm / catalogue_nm == pytest.approx(0.75, abs=0.05)


@pytest.mark.parametrize("name", ["ideal", "xm430_assumed"])
def test_an_assumed_gearing_drives_forward_as_the_catalogue_says(name) -> None:
    drive = GEARINGS[name].drive_of(XM430_W350)
    for current_a in (0.3, 1.2):
        forward_nm = drive.friction.forward_nm(drive.kt_nm_a * current_a, 0.0)
        assert forward_nm == pytest.approx(1.769 * current_a - 0.2214, rel=1e-9)
