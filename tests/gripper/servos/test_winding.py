"""Servos that measure and limit the current of the supply: conversions, and the cap by them.

The servo of these tests follows the bus law of logs and of Rhoban/bam, thread 14; no formula of the
product is used for it.
"""

import random
from itertools import pairwise
from math import copysign, exp, inf, sqrt

import pytest

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import MODELS, XC330_M288, XL330_M288, XM430_W350
from gripper.force.ramp import ForceRamp, heat_note
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics, Transmission
from gripper.servos.goal_limits import ServoGoal
from gripper.servos.group import for_hours
from gripper.servos.winding import Supply, WindingHeat, longest_s, winding_a
from gripper.settings import GripperSettings
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle


@pytest.mark.parametrize(
    ("model", "goal_raw", "phase_a"),
    [
        (XL330_M288, 0, 0.0),
        (XL330_M288, 50, 0.27),
        (XL330_M288, 100, 0.38),
        (XL330_M288, 350, 0.72),
        (XL330_M288, 1000, 1.21),
        (XC330_M288, 72, 0.36),
        (XC330_M288, 450, 0.90),
        (XM430_W350, 100, 0.269),
    ],
)
def test_goal_currents_and_the_currents_of_the_winding(model, goal_raw, phase_a) -> None:
    assert model.winding_a(goal_raw) == pytest.approx(phase_a, abs=0.005)
    assert round(model.current_counts(model.winding_a(goal_raw))) == goal_raw


def duty_of(goal_a: float, supply_v: float, ohm: float, back_v: float = 0.0) -> float:
    """Duty at which the current of the supply is a goal from 0 up, with a voltage of motion."""
    return (back_v + sqrt(back_v**2 + 4.0 * supply_v * ohm * goal_a)) / (2.0 * supply_v)


def test_a_motion_never_makes_more_current_than_asked() -> None:
    draw, model = random.Random(3), XL330_M288
    for _ in range(300):
        asked_a, speed_rad_s = draw.uniform(0.05, 1.2), draw.uniform(-1.5, 1.5)
        back_v = model.back_emf_v_s * speed_rad_s
        raw = round(model.current_counts(asked_a, 5.0, max(0.0, -speed_rad_s)))
        duty = duty_of(1e-3 * raw, 5.0, model.winding_ohm, back_v)
        # Half a count, and the current that a short circuit brakes with.
        root_v = sqrt(back_v**2 + 4.0 * 5.0 * model.winding_ohm * 1e-3 * raw)
        most_a = asked_a + 0.6e-3 * 5.0 / max(root_v, 0.1)
        short_a = max(0.0, -back_v) / model.winding_ohm
        assert (duty * 5.0 - back_v) / model.winding_ohm <= max(most_a, short_a)
        # A part stops the finger before the next write.
        if speed_rad_s > 0.0:
            stopped_a = duty_of(1e-3 * raw, 5.0, model.winding_ohm) * 5.0 / model.winding_ohm
            assert stopped_a == pytest.approx(asked_a, abs=most_a - asked_a)


def test_the_supply_is_the_mean_of_twenty_readings_or_more() -> None:
    draw, supply, two_peaks_v = random.Random(1), Supply(), (4.4, 5.6)
    first_v = [supply.steady_v(draw.choice(two_peaks_v), under_torque=True) for _ in range(19)]
    assert min(first_v[5:]) > 5.0
    later_v = [supply.steady_v(draw.choice(two_peaks_v), under_torque=True) for _ in range(400)]
    assert max(abs(one - 5.0) for one in later_v[30:]) < 0.4
    assert supply.steady_v(5.6, under_torque=False) == pytest.approx(5.6)


@pytest.mark.parametrize("cap_n", [5.0, 15.0, 30.0])
def test_no_servo_of_the_logs_presses_above_the_cap_before_pads_show_it(cap_n: float) -> None:
    """Torque by the winding's voltage as in logs of rising weights; 0.3 N are sample noise."""
    draw, model = random.Random(5), XL330_M288
    drive = DriveCharacteristic.catalogue(model)
    for _ in range(300):
        radius_m, true_v = draw.uniform(0.008, 0.06), draw.uniform(4.75, 5.5)
        path, supply = Transmission(drive, radius_m), Supply()
        for _ in range(draw.choice((1, 20, 40))):
            supply_v = supply.steady_v(draw.gauss(true_v, 0.6), under_torque=True)
        current_a = min(path.pressing_current_a(cap_n), model.stall_current_a)
        goal_a = 1e-3 * round(model.current_counts(current_a, supply_v))
        ohm = model.winding_ohm * draw.uniform(0.83, 1.2)
        motor_v = min(1.0, duty_of(goal_a, true_v, ohm)) * true_v
        torque_nm = (motor_v - draw.uniform(0.1, 0.3)) / draw.uniform(13.0, 17.0)
        assert torque_nm / radius_m <= cap_n + 0.3
    assert drive.falling_a_nm < 2 / 3 * drive.rising_a_nm


@pytest.mark.parametrize(("duty", "speed_rad_s"), [(-0.12, -0.8), (-0.3, 0.0), (0.5, 4.0)])
def test_the_current_of_a_warm_winding_is_found_by_the_duty(duty, speed_rad_s) -> None:
    """The supply is off by 4 %, the winding by 12 %."""
    true_a = (duty * 5.2 - 0.44 * speed_rad_s) / (1.12 * XL330_M288.winding_ohm)
    present_a = copysign(1e-3 * round(1e3 * abs(duty * true_a)), true_a)
    current_a, motor_a = winding_a(XL330_M288, present_a, duty, 5.0, speed_rad_s)
    assert current_a == pytest.approx(true_a, abs=0.25 * abs(true_a) + 0.01)
    assert (motor_a is None) == (abs(duty) <= 0.2)


def test_a_servo_without_torque_has_no_current() -> None:
    assert winding_a(XL330_M288, 0.0, 0.0, 5.0, 1.0) == (0.0, None)
    assert winding_a(XM430_W350, 0.2, 0.1, 12.0, 1.0) == (0.2, 0.2)
    assert exp(2.0 * XL330_M288.kt_sd) * XL330_M288.kt_nm_a > 3.4 / 13.0


# -- Heat: what is held for hours, for a short time, and what is left then -------------------------


PERIOD_S = 0.005


def loaded(heat: WindingHeat, current_a: float, time_s: float, from_s: float = 0.0) -> float:
    """Load a winding; return the time in s until it is hot, or the whole time."""
    for period in range(round(time_s / PERIOD_S)):
        heat.add(from_s + period * PERIOD_S, current_a)
        if heat.hot:
            return period * PERIOD_S
    return time_s


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_hours_at_the_holding_current_and_a_second_at_the_peak_at_any_time(model) -> None:
    heat = WindingHeat(model)
    heat.add(0.0, -model.holding_a)
    heat.add(7200.0, -model.holding_a)
    assert not heat.hot
    assert heat.limit_a == model.stall_current_a
    assert loaded(heat, model.peak_a, 60.0, 7200.0) == pytest.approx(1.0, abs=0.02)
    for current_a in (1.1 * model.holding_a, 1.2 * model.peak_a):
        most_s = loaded(WindingHeat(model), current_a, 300.0)
        assert most_s == pytest.approx(longest_s(model, current_a), abs=0.02)
    assert longest_s(model, model.holding_a) == inf


def test_a_hot_winding_is_lowered_evenly_and_keeps_its_holding_current_until_it_cools() -> None:
    heat, at_s = WindingHeat(XM430_W350), 0.0
    limits_a = []
    for _ in range(4000):
        at_s += PERIOD_S
        heat.add(at_s, min(0.8, heat.limit_a))
        limits_a.append(heat.limit_a)
    lowered_a = [one for one in limits_a if one < 1.0]
    assert max(a - b for a, b in pairwise(lowered_a)) < 0.005
    assert lowered_a[-1] == pytest.approx(0.4, abs=1e-3)
    heat.add(at_s + 3600.0, 0.4)
    assert heat.hot
    heat.add(at_s + 3610.0, 0.1)
    assert heat.hot
    heat.add(at_s + 3620.0, 0.1)
    assert not heat.hot
    assert heat.limit_a == XM430_W350.stall_current_a


def test_a_grip_beyond_the_holding_current_gets_a_note_with_its_time() -> None:
    mechanics = Mechanics(settings := GripperSettings(), ParallelLinkage(link_m=0.06))
    assert heat_note(5.0, mechanics) == ""
    assert "bears 0.40 A for hours: after" in heat_note(12.0, mechanics)
    goals = [ServoGoal(angle_rad=0.1, current_a=a) for a in (0.7, 0.2)]
    assert [goal.current_a for goal in for_hours(goals, settings)] == [0.4, 0.2]


def test_a_hot_winding_lowers_the_current_and_the_part_stays(make_started) -> None:
    cell = make_started(current_max_a=0.8, force_max_n=30.0)
    outcome = cell.gripper.grasp(ForceRamp.linear(14.0, rate_n_s=10.0))
    assert outcome.result is GraspResult.FORCE_REACHED
    heats = cell.gripper._servos.feedback._heats
    for heat in heats.values():
        heat.add(cell.clock.monotonic() + 60.0, 0.8)
        heat.add(cell.clock.monotonic() + 120.0, 0.0)
        heat.add(cell.clock.monotonic(), 0.0)
    assert all(heat.hot for heat in heats.values())
    cycles: list[Cycle] = []
    cell.gripper.hold(2.0, cycles.append)
    assert 0.3 < cycles[-1].goal_current_a < 0.41
    assert 11.0 < cycles[-1].setpoint_n < 13.0
    assert cell.force_n > 8.0
    assert cell.gripper.statistics.derated > 0


def test_nothing_that_heats_is_left_without_supervision(make_started) -> None:
    cell = make_started(current_max_a=0.8, force_max_n=30.0)
    cell.gripper.grasp(ForceRamp.linear(13.6, rate_n_s=10.0))
    assert cell.register(0, "goal_current") > 0.45 / 2.69e-3
    cell.gripper.keep_grip()
    assert cell.register(0, "goal_current") <= 0.4 / 2.69e-3 + 1
    cell.clock.sleep(1.0)
    assert cell.force_n > 10.0
