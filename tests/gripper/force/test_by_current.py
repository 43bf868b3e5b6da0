"""The grip force by the motors' current alone, against the true one of the simulated fingers."""

from collections.abc import Callable
from functools import partial
from math import hypot
from typing import Any

import pytest

from gripper.dynamixel.models import XC330_M288, XL330_M288
from gripper.errors import LimitExceeded, PartLost
from gripper.force.ramp import ForceRamp
from gripper.gripper import Gripper
from gripper.settings import largest_setpoint_n
from gripper.values.outcome import GraspOutcome, GraspResult
from gripper.values.state import Cycle
from tests.marks import LONG

_SDS = (0.7, 0.05)
"""Uncertainty of servos whose torque was measured with weights, and no friction so far."""


@pytest.fixture
def make_cell(make_cell: Callable[..., Any]) -> Callable[..., Any]:
    return partial(make_cell, drive_sds=_SDS, catalogue_torque=True)


def by_current(cell: Any) -> Gripper:
    return Gripper(cell.bus, cell.linkage, cell.settings, clock=cell.clock, force_sensor=None)


def closed(
    cell: Any, force_n: float = 5.0, *, rate_n_s: float = 5.0
) -> tuple[Gripper, GraspOutcome]:
    """The outcome of a grasp in which no contact was claimed before there was a force."""
    gripper = by_current(cell)

    def watch(cycle: Cycle) -> None:
        # At an opening of 0 the fingers press on each other.
        pressed = cell.force_n > 0.5 or cycle.state.aperture_m < cell.settings.aperture_min_m
        assert cycle.force.grip_n == 0.0 or pressed

    gripper.start()
    gripper.open()
    return gripper, gripper.grasp(ForceRamp.linear(force_n, rate_n_s, 0.5), watch)


@pytest.mark.parametrize("model", [XL330_M288, XC330_M288])
def test_servos_that_measure_the_current_of_their_supply_are_refused(make_cell, model) -> None:
    with pytest.raises(LimitExceeded, match="measures the current of its supply"):
        by_current(make_cell(model=model, current_max_a=0.35))


SOFT = {"stiffness_n_m": 1000.0}
RUNS_AWAY = pytest.mark.xfail(
    strict=True,
    reason="on a soft part the fingers reach 45 mm/s: above 40 mm/s the sample by current is 0, "
    "and the part counts as lost",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cell_has", "within_n", "rate_n_s"),
    [
        ({}, 0.4, 20.0),
        LONG({"friction_error": 0.3}, 0.4, 20.0),
        ({"friction_error": -0.3}, 0.4, 20.0),
        ({"kt_error": 0.1}, 0.8, 20.0),
        LONG({"kt_error": 0.1}, 0.8, 5.0),
        LONG({"kt_error": -0.1}, 0.8, 20.0),
        ({"n_servos": 1}, 0.4, 20.0),
        (SOFT, 0.5, 5.0),
        pytest.param(SOFT, 0.5, 20.0, marks=RUNS_AWAY),
        # The fingers start on the part.
        ({"aperture_open_m": 0.0125, "aperture_m": 0.0125}, 0.3, 5.0),
    ],
)
def test_five_newtons_by_current_are_five_newtons_but_for_the_torque_constant(
    make_cell, cell_has: dict[str, Any], within_n: float, rate_n_s: float
) -> None:
    cell = make_cell(**cell_has)
    gripper, outcome = closed(cell, rate_n_s=rate_n_s)
    assert outcome.result is GraspResult.FORCE_REACHED
    assert cell.force_n == pytest.approx(5.0, abs=within_n)
    gripper.release()
    assert cell.force_n == 0.0


@pytest.mark.slow
def test_the_samples_carry_what_the_torque_figures_leave_open(make_cell) -> None:
    cell = make_cell(kt_error=0.1)
    samples = []
    gripper, _ = closed(cell)
    gripper.hold(0.1, lambda cycle: samples.append(cycle.force))
    drive = next(iter(gripper.read_drives().drives.values()))
    friction_n = drive.breakaway_a / drive.rising_a_nm / cell.linkage.link_m
    noise_n = hypot(_SDS[1] * (5.0 + friction_n), drive.friction_sd * friction_n)
    assert samples[-1].noise_n == pytest.approx(noise_n, rel=0.1)
    assert abs(samples[-1].grip_n - cell.force_n) < 2.0 * samples[-1].noise_n


@pytest.mark.slow
@pytest.mark.parametrize("friction_error", [-0.5, 0.5])
def test_friction_is_no_part(make_cell, friction_error: float) -> None:
    cell = make_cell(present=False, friction_error=friction_error)
    assert closed(cell)[1].result is GraspResult.NO_CONTACT


@pytest.mark.slow
@pytest.mark.parametrize("stiffness_n_m", [3000.0, 20_000.0])
def test_a_part_that_is_taken_away_is_lost(make_cell, stiffness_n_m) -> None:
    cell = make_cell(stiffness_n_m=stiffness_n_m)
    gripper, _ = closed(cell)

    def take(cycle: Cycle) -> None:
        cell.part.present = False

    with pytest.raises(PartLost):
        gripper.hold(1.0, take)


@pytest.mark.slow
def test_the_true_force_keeps_its_cap_where_the_torque_constant_is_wrong(make_cell) -> None:
    cell = make_cell(kt_error=0.1, friction_error=-0.2, force_max_n=15.0)
    gripper = by_current(cell)
    most_n = largest_setpoint_n(gripper.settings.force_max_n)
    cap_n = gripper.settings.force_max_n
    assert cap_n < 15.0
    with pytest.raises(LimitExceeded, match=f"its overshoot stays below force_max_n = {cap_n} N"):
        gripper.check_ramp(ForceRamp.linear(most_n + 0.1, 5.0))
    closed(cell, most_n)
    assert 12.0 < cell.peak_n < 15.0


def test_a_cap_below_what_the_current_can_tell_is_refused(make_cell) -> None:
    cell = make_cell(force_max_n=1.1, drive_sds=(0.7, 0.1))
    with pytest.raises(LimitExceeded, match=r"is exact to 0\.5 N, which leaves 0\.6 N"):
        by_current(cell)
