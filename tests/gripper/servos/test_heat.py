"""Heat of the windings: what a servo holds for hours, for a short time, and what is left then."""

from itertools import pairwise
from math import inf

import pytest

from gripper.dynamixel.models import MODELS, XL330_M288, XM430_W350
from gripper.force.ramp import ForceRamp, heat_note
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.servos.goal_limits import ServoGoal
from gripper.servos.group import for_hours
from gripper.servos.winding import WindingHeat, longest_s
from gripper.settings import GripperSettings
from gripper.values.outcome import GraspResult

PERIOD_S = 0.005


def loaded(heat: WindingHeat, current_a: float, time_s: float, from_s: float = 0.0) -> float:
    """Load a winding; return the time in s until it is hot, or the whole time."""
    for period in range(round(time_s / PERIOD_S)):
        heat.add(from_s + period * PERIOD_S, current_a)
        if heat.hot:
            return period * PERIOD_S
    return time_s


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_hours_at_the_holding_current_and_two_seconds_at_the_peak_at_any_time(model) -> None:
    heat = WindingHeat(model)
    heat.add(0.0, -model.holding_a)
    heat.add(7200.0, -model.holding_a)
    assert not heat.hot
    assert heat.limit_a == model.stall_current_a
    assert loaded(heat, model.peak_a, 60.0, 7200.0) == pytest.approx(2.0, abs=0.02)
    cold = WindingHeat(model)
    most_s = loaded(cold, 1.2 * model.holding_a, 300.0)
    assert most_s == pytest.approx(longest_s(model, 1.2 * model.holding_a), abs=0.02)
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
    heat.add(at_s + 3601.0, 0.1)
    heat.add(at_s + 3602.0, 0.1)
    assert not heat.hot


def test_a_pause_without_readings_counts_with_the_last_current() -> None:
    heat = WindingHeat(XL330_M288)
    heat.add(0.0, 0.7)
    heat.add(5.0, 0.0)
    assert not heat.hot
    heat.add(5.1, 0.7)
    heat.add(15.0, 0.0)
    assert heat.hot


def test_a_grip_beyond_the_holding_current_gets_a_note_with_its_time() -> None:
    settings, linkage = GripperSettings(), ParallelLinkage(link_m=0.06)
    assert heat_note(5.0, settings, linkage) == ""
    assert "bears 0.40 A for hours: after" in heat_note(12.0, settings, linkage)
    goals = [ServoGoal(angle_rad=0.1, current_a=a) for a in (0.7, 0.2)]
    assert [goal.current_a for goal in for_hours(goals, settings)] == [0.4, 0.2]


def test_a_hot_winding_lowers_the_current_and_the_part_stays(make_started) -> None:
    cell = make_started(current_max_a=0.8, force_max_n=30.0)
    outcome = cell.gripper.grasp(ForceRamp.linear(12.0, rate_n_s=10.0))
    assert outcome.result is GraspResult.FORCE_REACHED
    heats = cell.gripper._servos.feedback._heats
    for heat in heats.values():
        heat.add(cell.clock.monotonic() + 60.0, 0.8)
        heat.add(cell.clock.monotonic() + 120.0, 0.0)
        heat.add(cell.clock.monotonic(), 0.0)
    assert all(heat.hot for heat in heats.values())
    goals_a: list[float] = []
    cell.gripper.hold(2.0, lambda cycle: goals_a.append(cycle.goal_current_a))
    assert 0.3 < goals_a[-1] < 0.41
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
