"""Steps of a grasp: ramps, a ramp that is ended on request, holding."""

from types import SimpleNamespace
from typing import Any

import pytest

from gripper.errors import GraspStopped, PartLost
from gripper.force.grasp import GripStep, HoldStep, RampTime
from gripper.force.loop import Moment
from gripper.force.ramp import ForceRamp
from gripper.servos.goal_limits import ServoGoal
from gripper.settings import GripperSettings
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase
from tests.marks import LONG
from tests.values import make_state

LINEAR = ForceRamp.linear(8.0, 10.0, hold_s=0.3)


def test_the_set_point_stays_and_the_force_does_not_rise_any_more(make_started) -> None:
    cell = make_started(approach_speed_m_s=0.01, rate_hz=200.0)
    ask, after = cell.once(cell.gripper.end_ramp, at_n=3.5), []

    def observe(cycle: Cycle) -> None:
        ask(cycle)
        if cell.acted_s:
            after.append((cycle.setpoint_n, cell.force_n))

    outcome = cell.gripper.grasp(LINEAR, observe)
    assert (outcome.result, outcome.ended_early) == (GraspResult.FORCE_REACHED, True)
    assert cell.gripper.phase is GripperPhase.HOLDING
    cell.gripper.hold(0.5, observe)
    setpoints_n, forces_n = map(set, zip(*after, strict=True))
    (at_n,) = setpoints_n
    assert 3.5 <= at_n <= 4.0
    assert outcome.final_force_n == pytest.approx(at_n, abs=0.4)
    assert at_n - 0.6 <= min(forces_n) <= max(forces_n) <= at_n + 0.35
    assert outcome.overshoot_n <= 0.4


@pytest.mark.slow
def test_a_request_between_grasps_or_after_the_ramp_is_not_kept(started) -> None:
    started.gripper.end_ramp()
    settling_s: list[float] = []

    def when_it_is_over(cycle: Cycle) -> None:
        if cycle.setpoint_n == LINEAR.final_n:
            settling_s.append(cycle.t_s)
            if cycle.t_s - settling_s[0] > LINEAR.hold_s - 1e-6:
                started.gripper.end_ramp()

    assert not started.gripper.grasp(LINEAR, when_it_is_over).ended_early
    assert settling_s[-1] - settling_s[0] > LINEAR.hold_s - 1e-6
    assert started.force_n == pytest.approx(8.0, rel=0.1)
    started.gripper.end_ramp()
    started.gripper.release()
    started.gripper.end_ramp()
    assert not started.gripper.grasp(LINEAR).ended_early


@pytest.mark.parametrize(("close", "width_m"), [("grasp", 0.012), ("press_pads_together", 0.003)])
def test_asked_in_the_approach_the_ramp_ends_as_it_begins(make_started, close, width_m) -> None:
    started = make_started(width_m=width_m)
    ask, setpoints_n = started.once(started.gripper.end_ramp, in_s=0.1), set()

    def observe(cycle: Cycle) -> None:
        ask(cycle)
        setpoints_n.add(cycle.setpoint_n)

    outcome = getattr(started.gripper, close)(LINEAR, observe)
    assert outcome.ended_early
    assert outcome.contact_aperture_m == pytest.approx(width_m, abs=0.0006)
    assert len(setpoints_n - {0.0}) == 1
    assert started.peak_n < 4.0


def test_a_further_rise_ends_where_pads_were_pressed_together(make_started) -> None:
    cell = make_started(width_m=0.0003, noise_n=0.1)
    cell.gripper.press_pads_together(ForceRamp.linear(3.0, 5.0))
    more = cell.gripper.squeeze(ForceRamp.linear(12.0, 10.0))
    assert "gripper.aperture_min_mm is 0.5)" in more.unreached
    assert cell.peak_n < 4.0


def test_a_force_that_could_not_hold_a_part_grows_until_it_can(make_started) -> None:
    cell = make_started(stiffness_n_m=2000.0, approach_speed_m_s=0.004, noise_n=0.02)
    asked_n: list[float] = []

    def at_once(cycle: Cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING:
            asked_n.append(cycle.setpoint_n)
            cell.gripper.end_ramp()

    assert cell.gripper.grasp(LINEAR, at_once).ended_early
    assert asked_n[-1] >= cell.settings.contact_force_n
    assert cell.peak_n < 2.0


def test_a_stop_comes_before_the_end_of_a_ramp(started) -> None:
    def ask() -> None:
        started.gripper.end_ramp()
        started.gripper.request_stop()

    with pytest.raises(GraspStopped):
        started.gripper.grasp(LINEAR, started.once(ask, at_n=4.0))
    assert started.gripper.phase is GripperPhase.HOLDING


def test_a_part_that_is_lost_as_its_ramp_ends_is_lost(make_started) -> None:
    # No force counts as reached before the pads, which are late, have shown that it is gone.
    cell = make_started(settle_tolerance_n=0.0, settle_tolerance_share=0.0)

    def drop() -> None:
        cell.gripper.end_ramp()
        cell.part.present = False

    assert cell.gripper.grasp(LINEAR, cell.once(drop, at_n=4.0)).result is GraspResult.PART_LOST
    assert cell.gripper.phase is GripperPhase.IDLE


@pytest.mark.slow
@pytest.mark.parametrize("noise_n", [LONG(0.02), 0.2])
def test_a_part_that_yields_until_the_fingers_are_closed_is_held_with_what_it_bears(
    make_cell, noise_n: float
) -> None:
    # 1 N/mm: 3.5 N at the 0.5 mm to which the fingers close.
    cell = make_cell(width_m=0.004, stiffness_n_m=2000.0, noise_n=noise_n)
    gripper = cell.gripper
    gripper.start()
    outcome = gripper.grasp(LINEAR)
    assert outcome.result is GraspResult.FORCE_NOT_REACHED
    assert not outcome.ended_early
    assert outcome.final_force_n == pytest.approx(3.5, abs=0.7)
    assert gripper.phase is GripperPhase.HOLDING
    gripper.hold(2.0)
    gripper.hold_at(6.0, 1.0)
    gripper.hold_at(1.5)
    assert gripper.squeeze(LINEAR).unreached
    assert cell.force_n == pytest.approx(3.5, abs=1.0)
    assert cell.peak_n < 4.5
    gripper.release()
    assert gripper.phase is GripperPhase.IDLE


@pytest.mark.slow
def test_a_smaller_opening_while_pressing_lets_a_small_part_sink_deeper(make_started) -> None:
    cell = make_started(
        width_m=0.005, stiffness_n_m=6000.0, aperture_min_m=0.003, aperture_pressed_m=0.001
    )
    outcome = cell.gripper.grasp(ForceRamp.linear(8.0, 5.0, hold_s=1.0))
    assert (outcome.result, outcome.unreached) == (GraspResult.FORCE_REACHED, "")
    assert outcome.final_aperture_m == pytest.approx(0.0023, abs=2e-4)
    cell.gripper.hold(1.0)
    cell.gripper.release()
    cell.part.present = False
    empty = cell.gripper.grasp(LINEAR)
    assert empty.result is GraspResult.NO_CONTACT
    assert empty.final_aperture_m == pytest.approx(0.003, abs=5e-4)


SETTINGS = GripperSettings(settle_timeout_s=0.2)
WIDE_M = 0.01
UP = ForceRamp.linear(2.0, 10.0, 0.1, start_n=1.0)


def passed(time: RampTime, seconds: float, force_n: float) -> RampTime:
    for _ in range(round(seconds / 0.005)):
        time.advance(0.005, force_n, WIDE_M)
    return time


def test_the_hold_begins_when_the_force_has_risen_to_it() -> None:
    time = passed(RampTime(SETTINGS, UP), 0.15, 1.0)
    assert (time.holds, time.setpoint_n) == (False, 2.0)
    assert passed(time, 0.005, 1.8).holds
    assert not passed(time, 0.09, 1.8).settled(1.8)
    assert passed(time, 0.01, 1.8).settled(1.8)
    late = passed(RampTime(SETTINGS, UP), 0.1 + 0.205, 1.0)
    assert late.holds  # the time for it was up


def test_a_ramp_is_over_when_its_force_is_there_or_the_time_for_it_is_up() -> None:
    time = passed(RampTime(SETTINGS, ForceRamp.linear(4.0, 10.0, start_n=3.0)), 0.11, 3.9)
    assert time.settled(3.9)
    assert not time.settled(3.0)
    assert passed(time, 0.2, 3.9).settled(3.0)


def test_a_rise_ends_where_the_fingers_are_closed() -> None:
    time = passed(RampTime(SETTINGS, UP), 0.05, 1.5)
    time.advance(0.005, 1.4, SETTINGS.least_pressed_m)
    assert (time.ramp.final_n, time.requested_n) == (pytest.approx(1.4), 2.0)
    assert time.settled(1.4)


MOMENT = Moment(now_s=1.0, dt_s=0.005, state=make_state(1.0), sample=None)


def control(*, lost: bool = False, suspicious: bool = False) -> Any:
    """Return a control that holds 2 N, and whose part is there or not."""
    goals, quiet = ((ServoGoal(angle_rad=0.0, current_a=a),) * 2 for a in (0.3, 0.2))
    return SimpleNamespace(
        force_n=2.0,
        grip=SimpleNamespace(settings=SETTINGS, force_n=2.0, setpoint_n=2.0, opened_s=0.0),
        watch=SimpleNamespace(update=lambda _moment: lost, suspicious=suspicious),
        resume=lambda _end_n: None,
        slip=SimpleNamespace(check=lambda _moment, **_named: None),
        goals=lambda *_given, **_named: goals,
        quiet_goals=lambda _moment: quiet,
    )


def test_the_end_of_a_hold_leaves_no_push_in_force() -> None:
    step = HoldStep(SETTINGS, control(), 1.5 * MOMENT.dt_s)
    pushes, ends = step.step(MOMENT), step.step(MOMENT)
    assert [action.goals[0].current_a for action in (pushes, ends)] == [0.3, 0.2]
    assert (pushes.done, ends.done) == (False, True)


def test_holds_are_watched_for_a_slip_unless_the_part_is_in_doubt() -> None:
    for suspicious in (True, False):
        held, checked_n = control(suspicious=suspicious), list[float]()
        held.slip.check = lambda _moment, setpoint_n, n=checked_n, **_: n.append(setpoint_n)
        step = GripStep(SETTINGS, held, UP)
        HoldStep(SETTINGS, held, 0.1).step(MOMENT)
        for _ in range(30):
            step.step(MOMENT)
        assert len(checked_n) == (0 if suspicious else 1 + 11)
    with pytest.raises(PartLost, match=r"at an opening of 23\.4 mm"):
        GripStep(SETTINGS, control(lost=True), UP).step(MOMENT)
