"""Identification of a drive, with synthetic data of the friction law M6 of arXiv 2410.08650."""

from dataclasses import dataclass, replace
from math import exp

import numpy as np
import pytest

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import MODELS
from gripper.mechanics.identification import FreePoint, LoadPoint, change, fit_friction, fit_load

SPEEDS_RAD_S = (0.15, 0.25, 0.4, 0.65)
MODEL = MODELS["XM430-W350"]
CATALOGUE = DriveCharacteristic.catalogue(MODEL)


@dataclass(frozen=True)
class Gearing:
    """Friction law M6 without its quadratic part, at the output."""

    kt_nm_a: float
    base_nm: tuple[float, float]
    drive: tuple[float, float]
    load: tuple[float, float]
    stribeck: tuple[float, float]
    viscous_nm_s: float

    def slow(self, speed_rad_s: float) -> float:
        return exp(-((abs(speed_rad_s) / self.stribeck[0]) ** self.stribeck[1]))

    def driven_share(self, speed_rad_s: float = 0.0) -> float:
        """Share of the motor's torque that the gearing takes."""
        return self.drive[0] + self.slow(speed_rad_s) * self.drive[1]

    def free_a(self, speed_rad_s: float) -> float:
        slow = self.slow(speed_rad_s)
        friction_nm = self.base_nm[0] + slow * self.base_nm[1] + self.viscous_nm_s * speed_rad_s
        return friction_nm / (self.kt_nm_a * (1.0 - self.driven_share(speed_rad_s)))

    def loaded_a(self, load_nm: float, *, rises: bool) -> float:
        """Current at rest at which a load begins to rise, or to fall."""
        base_nm, driven, sign = sum(self.base_nm), self.driven_share(), 1.0 if rises else -1.0
        # |Te le - Tm lm| with both torques of opposite signs is their sum.
        loaded_nm = load_nm * (1.0 + sign * sum(self.load)) + sign * base_nm
        if loaded_nm < 0.0:
            # The motor drives the load away: one sign of both, and the larger loss counts.
            by_load, by_motor = (
                loaded_nm / (1.0 + driven),
                load_nm * (1.0 + sum(self.load)) - base_nm,
            )
            loaded_nm = max(by_load, by_motor / (1.0 - driven))
            return loaded_nm / self.kt_nm_a
        return loaded_nm / (self.kt_nm_a * (1.0 - sign * driven))


# The figures in the order of the fields.
GEARINGS = {
    "XL330": Gearing(0.366, (0.0048, 0.0047), (0.267, 0.0), (0.0, 0.081), (2.89, 8.7), 0.0054),
    "MX-64": Gearing(1.602, (0.0, 0.123), (0.311, 0.188), (0.0, 0.014), (2.58, 0.84), 0.025),
    "MX-106": Gearing(2.210, (0.0, 0.122), (0.198, 0.199), (0.022, 0.087), (1.75, 1.14), 0.051),
}


def free_points(
    gearing: Gearing, *, speeds=SPEEDS_RAD_S, directions=(-1.0, 1.0), offset_a=0.0
) -> list[FreePoint]:
    draw = np.random.default_rng(1)
    return [
        FreePoint(
            sign * speed,
            sign * gearing.free_a(speed) * (1.0 + draw.normal(0.0, 0.01)) + offset_a,
            0.01 * gearing.free_a(speed),
        )
        for speed in speeds
        for sign in directions
    ]


@pytest.mark.parametrize("name", GEARINGS)
def test_four_speeds_in_both_directions_show_the_friction_at_rest(name: str) -> None:
    gearing = GEARINGS[name]
    offset_a = 0.03 * gearing.free_a(0.0)
    fitted = fit_friction(free_points(gearing, offset_a=offset_a), CATALOGUE)
    true_a = gearing.free_a(0.0)
    assert fitted.measured
    assert fitted.breakaway_a == pytest.approx(true_a, rel=0.1)
    assert fitted.offset_a == pytest.approx(offset_a, abs=0.02 * true_a)
    for speed in SPEEDS_RAD_S:
        assert fitted.friction_a(speed) == pytest.approx(gearing.free_a(speed), rel=0.05)


def test_one_motion_shows_friction_and_leaves_the_rest_uncertain() -> None:
    gearing = GEARINGS["MX-64"]
    slow = fit_friction(free_points(gearing, speeds=(0.15,), directions=(-1.0,)), CATALOGUE)
    fast = fit_friction(free_points(gearing, speeds=(2.0,), directions=(-1.0,)), CATALOGUE)
    assert slow.friction_a(0.15) == pytest.approx(gearing.free_a(0.15), rel=0.08)
    assert slow.friction_sd < fast.friction_sd < CATALOGUE.friction_sd


def test_what_was_measured_is_a_prior_that_new_motions_refine() -> None:
    gearing = GEARINGS["XL330"]
    first = fit_friction(free_points(gearing), CATALOGUE)
    colder = replace(gearing, base_nm=tuple(1.1 * nm for nm in gearing.base_nm))
    prior = replace(first, friction_sd=0.2)
    fitted = fit_friction(free_points(colder, speeds=(0.25,)), prior)
    assert fitted.friction_a(0.25) == pytest.approx(colder.free_a(0.25), rel=0.04)
    assert fit_friction([], prior) is prior


def test_currents_that_fall_with_the_speed_show_no_friction_that_drives() -> None:
    currents_a = zip(SPEEDS_RAD_S, (0.17, 0.15, 0.12, 0.09), strict=True)
    points = [FreePoint(speed, current_a, 0.005) for speed, current_a in currents_a]
    drive = fit_friction(points, CATALOGUE)
    assert all(drive.friction_a(speed_rad_s) > 0.0 for speed_rad_s in (0.0, 0.65, 4.0, 20.0))
    assert change(FreePoint(4.0, 0.04, 0.06), replace(drive, measured_s=0.0)) > 0.0


def test_only_a_measured_friction_is_contradicted() -> None:
    point = FreePoint(-0.3, -0.25, 0.002)
    assert change(point, CATALOGUE) == 1.0
    measured = replace(CATALOGUE, friction_sd=0.05)
    assert change(point, measured) == pytest.approx(0.25 / CATALOGUE.breakaway_a)
    assert change(point._replace(current_a=-0.052), measured) == 1.0


def load_points(gearing: Gearing, *, rises: bool, seed: int) -> list[LoadPoint]:
    """250 samples of a load that changes slowly; the finger stands for a while at first."""
    draw = np.random.default_rng(seed)
    loads = np.linspace(0.08, 0.55, 200) * gearing.kt_nm_a / 1.77
    if not rises:
        loads = loads[::-1]
    start_a, end_a = (gearing.loaded_a(loads[0], rises=one) for one in (not rises, rises))
    stuck = [(loads[0], current_a) for current_a in np.linspace(start_a, end_a, 50)]
    moving = [(load_nm, gearing.loaded_a(load_nm, rises=rises)) for load_nm in loads]
    noise_nm = 0.02 * gearing.kt_nm_a / 1.77
    return [LoadPoint(nm + draw.normal(0.0, noise_nm), a) for nm, a in stuck + moving]


@pytest.mark.parametrize("name", GEARINGS)
def test_a_press_shows_amperes_for_each_newton_of_both_directions(name: str) -> None:
    gearing = GEARINGS[name]
    before = fit_friction(free_points(gearing), CATALOGUE)
    rising, falling = (load_points(gearing, rises=one, seed=2) for one in (True, False))
    fitted = fit_load(rising, falling, before)
    slopes = [
        (gearing.loaded_a(9.0, rises=one) - gearing.loaded_a(8.0, rises=one))
        for one in (True, False)
    ]
    driven = gearing.driven_share()
    assert fitted.rising_a_nm == pytest.approx(slopes[0], rel=0.1)
    assert fitted.falling_a_nm == pytest.approx(slopes[1], rel=0.1)
    assert fitted.yielding_share == pytest.approx((1.0 - driven) / (1.0 + driven), rel=0.15)
    assert fitted.breakaway_a == pytest.approx(gearing.loaded_a(0.0, rises=True), rel=0.1)
    assert fitted.load_sd <= 0.1
    assert fitted.kt_nm_a == before.kt_nm_a, "no pad moves the motor constant"


def test_too_little_of_a_press_leaves_what_was_known() -> None:
    rising = load_points(GEARINGS["XL330"], rises=True, seed=3)
    assert fit_load(rising[:4], [], CATALOGUE) is CATALOGUE
    assert fit_load(rising[:50], [], CATALOGUE) is CATALOGUE, "it has not moved"


def test_pads_and_motor_constant_disagree_beyond_the_spread_of_the_model() -> None:
    assert CATALOGUE.disagreement(MODEL) == 1.0
    for times, disagrees in ((1.3, False), (1.4, True), (0.7, True)):
        drive = replace(CATALOGUE, rising_a_nm=times * CATALOGUE.rising_a_nm, load_sd=0.02)
        assert drive.disagreement(MODEL) == pytest.approx(1.0 / times if disagrees else 1.0)
        assert replace(drive, load_sd=0.2).disagreement(MODEL) == 1.0
    # The pads may be wrong: the cap goes by what makes more force.
    weak_pads = replace(CATALOGUE, rising_a_nm=1.4 * CATALOGUE.rising_a_nm, load_sd=0.02)
    assert weak_pads.most_torque_nm_a == CATALOGUE.kt_nm_a
