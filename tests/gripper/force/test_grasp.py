"""Steps of a grasp: ramps and their levels, a ramp that is ended on request, holding."""

import re
import threading
from types import SimpleNamespace

import pytest

from gripper.errors import ForceSensorStale, GraspStopped, PartLost
from gripper.force.grasp import GripStep, HoldStep, RampTime
from gripper.force.loop import Moment
from gripper.force.ramp import ForceRamp
from gripper.servos.goal_limits import ServoGoal
from gripper.settings import GripperSettings
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase
from tests.values import make_state

LINEAR = ForceRamp.linear(8.0, 10.0, hold_s=0.3)
RAMPS = {
    "linear": LINEAR,
    "staircase": ForceRamp.staircase((2.0, 4.0, 8.0), 10.0, 0.2),
    "s_curve": ForceRamp.s_curve(8.0, 1.0, hold_s=0.3),
}


class Asking:
    """Asks for the end of the ramp, and does more, when the set-point gets to a force."""

    def __init__(self, cell, at_n: float, *acts) -> None:
        self.cell = cell
        self.at_n = at_n
        self.acts = (cell.gripper.end_ramp, *acts)
        self.asked_at: int | None = None
        self.cycles: list[Cycle] = []
        self.force_n: list[float] = []

    def __call__(self, cycle: Cycle) -> None:
        self.cycles.append(cycle)
        self.force_n.append(self.cell.force_n)
        if self.asked_at is None and cycle.setpoint_n >= self.at_n:
            self.asked_at = len(self.cycles) - 1
            for act in self.acts:
                act()

    @property
    def setpoints_after_n(self) -> set[float]:
        """The set-points from the request on."""
        return {cycle.setpoint_n for cycle in self.cycles[self.asked_at :]}


@pytest.mark.parametrize("kind", RAMPS)
def test_the_set_point_stays_and_the_force_does_not_rise_any_more(make_started, kind: str) -> None:
    cell = make_started(approach_speed_m_s=0.01)
    asking = Asking(cell, 3.5)
    outcome = cell.gripper.grasp(RAMPS[kind], asking)
    assert (outcome.result, outcome.ended_early) == (GraspResult.FORCE_REACHED, True)
    assert len(asking.setpoints_after_n) == 1
    at_n = asking.setpoints_after_n.pop()
    assert 3.5 <= at_n <= 4.0
    assert outcome.final_force_n == pytest.approx(at_n, abs=0.4)
    assert cell.gripper.phase is GripperPhase.HOLDING
    cell.gripper.hold(0.5, asking)
    assert asking.setpoints_after_n == {at_n}
    assert max(asking.force_n[asking.asked_at :]) <= at_n + 0.35
    assert min(asking.force_n[asking.asked_at :]) >= at_n - 0.6
    assert outcome.overshoot_n <= 0.4


@pytest.mark.slow
def test_an_ended_ramp_takes_less_time_and_ends_at_the_level_that_was_next(make_cell) -> None:
    lasted: list[int] = []
    for at_n in (3.0, 99.0):
        cell = make_cell(approach_speed_m_s=0.01)
        cell.gripper.start()
        asking = Asking(cell, at_n)
        outcome = cell.gripper.grasp(RAMPS["staircase"], asking)
        assert outcome.ended_early is (at_n < 99.0)
        lasted.append(len(asking.cycles))
        assert asking.cycles[-1].level == (1 if outcome.ended_early else 2)
    assert lasted[0] < lasted[1] - 100


@pytest.mark.slow
def test_a_request_between_grasps_or_after_the_ramp_is_not_kept(started) -> None:
    started.gripper.end_ramp()
    settling: list[float] = []

    def when_it_is_over(cycle: Cycle) -> None:
        if cycle.level is not None:
            settling.append(cycle.t_s)
            if cycle.t_s - settling[0] > 0.3:
                started.gripper.end_ramp()

    outcome = started.gripper.grasp(LINEAR, when_it_is_over)
    assert not outcome.ended_early
    assert started.force_n == pytest.approx(8.0, abs=0.5)
    started.gripper.end_ramp()
    started.gripper.release()
    started.gripper.end_ramp()
    assert not started.gripper.grasp(LINEAR).ended_early


def test_asked_while_the_fingers_approach_the_ramp_ends_as_it_begins(started) -> None:
    cycles: list[Cycle] = []

    def while_closing(cycle: Cycle) -> None:
        cycles.append(cycle)
        if cycle.phase is GripperPhase.APPROACHING and len(cycles) == 20:
            started.gripper.end_ramp()

    outcome = started.gripper.grasp(LINEAR, while_closing)
    assert outcome.ended_early
    assert outcome.contact_aperture_m == pytest.approx(0.012, abs=0.0006)
    ramped = [cycle for cycle in cycles if cycle.phase is GripperPhase.RAMPING]
    assert len({cycle.setpoint_n for cycle in ramped if cycle.setpoint_n > 0.0}) == 1
    assert started.peak_n < 4.0


def test_a_force_that_could_not_hold_a_part_grows_until_it_can(make_started) -> None:
    cell = make_started(stiffness_n_m=2000.0, approach_speed_m_s=0.004, noise_n=0.02)
    asked: list[float] = []

    def at_once(cycle: Cycle) -> None:
        if cycle.phase is GripperPhase.RAMPING:
            asked.append(cycle.setpoint_n)
            cell.gripper.end_ramp()

    outcome = cell.gripper.grasp(LINEAR, at_once)
    assert outcome.ended_early
    assert asked[-1] >= cell.settings.contact_force_n
    assert cell.peak_n < 2.0


def test_a_stop_comes_first(started) -> None:
    asking = Asking(started, 4.0, started.gripper.request_stop)
    with pytest.raises(GraspStopped):
        started.gripper.grasp(LINEAR, asking)
    assert started.gripper.phase is GripperPhase.HOLDING
    assert asking.asked_at == len(asking.cycles) - 1


def test_a_part_that_is_lost_as_its_ramp_ends_is_lost(make_started) -> None:
    # No force counts as reached before the pads, which are late, have shown that it is gone.
    cell = make_started(settle_tolerance_n=0.0, settle_tolerance_share=0.0)

    def drop() -> None:
        cell.part.present = False

    outcome = cell.gripper.grasp(LINEAR, Asking(cell, 4.0, drop))
    assert outcome.result is GraspResult.PART_LOST
    assert cell.gripper.phase is GripperPhase.IDLE


def test_a_fault_while_the_force_settles_keeps_the_grip(make_started) -> None:
    cell = make_started(force_stale_s=0.06)

    def blind() -> None:
        # The force seen last is not the wanted one, so that the ended ramp waits for another.
        cell.sensor.gain = 0.5
        for _ in range(12):
            cell.clock.sleep(0.005)
        cell.sensor.dead = True

    with pytest.raises(ForceSensorStale, match="goals are frozen"):
        cell.gripper.grasp(LINEAR, Asking(cell, 5.0, blind))
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    # A crest of the square wave on the drive may last through the 60 ms.
    assert cell.force_n == pytest.approx(5.0, abs=1.1)


def test_what_is_held_after_an_ended_ramp_is_looked_after(started) -> None:
    assert started.gripper.grasp(LINEAR, Asking(started, 4.0)).ended_early
    started.part.present = False
    with pytest.raises(PartLost):
        started.gripper.hold(1.0)


def test_any_thread_may_ask(started) -> None:

    def from_elsewhere() -> None:
        thread = threading.Thread(target=started.gripper.end_ramp)
        thread.start()
        thread.join()

    asking = Asking(started, 4.0)
    asking.acts = (from_elsewhere,)
    assert started.gripper.grasp(LINEAR, asking).ended_early


@pytest.mark.slow
@pytest.mark.parametrize("noise_n", [0.02, 0.2])
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
    assert re.match(
        r"the part is too small or too soft for 8\.0 N: .*_min_mm is 0\.5", outcome.short
    )
    assert outcome.final_force_n == pytest.approx(3.5, abs=0.7)
    assert gripper.phase is GripperPhase.HOLDING
    gripper.hold(2.0)
    gripper.hold_at(6.0, 1.0)
    gripper.hold_at(1.5)
    assert gripper.squeeze(LINEAR).short
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
    assert (outcome.result, outcome.short) == (GraspResult.FORCE_REACHED, "")
    assert outcome.final_aperture_m == pytest.approx(0.0023, abs=2e-4)
    cell.gripper.hold(1.0)
    cell.gripper.release()
    cell.part.present = False
    empty = cell.gripper.grasp(LINEAR)
    assert empty.result is GraspResult.NO_CONTACT
    assert empty.final_aperture_m == pytest.approx(0.003, abs=5e-4)


SETTINGS = GripperSettings(settle_timeout_s=0.2)
WIDE_M = 0.01
STAIRS = ForceRamp.staircase((2.0, 4.0), 10.0, 0.1, start_n=1.0)


def passed(time: RampTime, seconds: float, force_n: float) -> RampTime:
    for _ in range(round(seconds / 0.005)):
        time.pass_by(0.005, force_n, WIDE_M)
    return time


def test_a_level_begins_when_the_force_has_risen_to_it() -> None:
    time = passed(RampTime(SETTINGS, STAIRS), 0.15, 1.0)
    assert (time.level, time.setpoint_n) == (None, pytest.approx(2.0))
    assert passed(time, 0.005, 1.8).level == 0
    assert passed(time, 0.1, 1.8).level is None  # on the way to the next one
    late = passed(RampTime(SETTINGS, STAIRS), 0.1 + 0.205, 1.0)
    assert late.level == 0  # the time for it was up


def test_a_ramp_is_over_when_its_force_is_there_or_the_time_for_it_is_up() -> None:
    ramp = ForceRamp.linear(4.0, 10.0, start_n=3.0)
    time = passed(RampTime(SETTINGS, ramp), 0.11, 3.9)
    assert time.settled(3.9)
    assert not time.settled(3.0)
    assert passed(time, 0.2, 3.9).settled(3.0)


def test_a_rise_ends_where_the_fingers_are_closed() -> None:
    time = passed(RampTime(SETTINGS, STAIRS), 0.05, 1.5)
    time.pass_by(0.005, 1.4, SETTINGS.least_pressed_m)
    assert (time.ramp.final_n, time.requested_n) == (pytest.approx(1.4), 4.0)
    assert time.settled(1.4)


class Control:
    """A control whose force is a value, and whose part is there or not."""

    def __init__(self, force_n: float, *, lost: bool = False, suspicious: bool = False) -> None:
        self.force_n = force_n
        self.asked: list[tuple[float, float | None]] = []
        self.grip = SimpleNamespace(force_n=force_n)
        self.watch = SimpleNamespace(lost=lambda _moment: lost, suspicious=suspicious)

    def resume(self) -> None:
        self.asked.clear()

    def goals(self, _moment, setpoint_n: float, *, arrival_n: float | None = None):
        self.asked.append((setpoint_n, arrival_n))
        return (ServoGoal(angle_rad=0.0, current_a=0.3),) * 2


class Slip:
    """A slip watch that notes the levels which it is asked about."""

    def __init__(self) -> None:
        self.levels: list[int | None] = []

    def check(self, _moment, level: int | None, *, setpoint_n: float) -> None:
        self.levels.append(level)


MOMENT = Moment(now_s=1.0, dt_s=0.005, state=make_state(1.0), sample=None)


def test_a_further_ramp_is_watched_at_its_levels_and_a_change_has_none() -> None:
    for slip in (Slip(), None):
        control = Control(2.0)
        step = GripStep(SETTINGS, control, STAIRS, slip=slip)
        actions = [step.step(MOMENT) for _ in range(30)]
        assert control.asked[0] == (pytest.approx(1.05), 2.0)
        if slip is None:
            assert {action.level for action in actions} == {None}
        else:
            assert [action.level for action in actions] == slip.levels
            assert set(slip.levels) == {None, 0}


def test_nothing_slips_while_the_part_is_in_doubt_and_a_lost_one_is_an_error() -> None:
    slip = Slip()
    GripStep(SETTINGS, Control(2.0, suspicious=True), STAIRS, slip=slip).step(MOMENT)
    assert slip.levels == []
    with pytest.raises(PartLost, match=r"at an opening of 23\.4 mm"):
        GripStep(SETTINGS, Control(2.0, lost=True), STAIRS).step(MOMENT)


@pytest.mark.parametrize(
    ("force_n", "result", "overshoot_n"),
    [(4.1, GraspResult.FORCE_REACHED, 0.1), (3.0, GraspResult.FORCE_NOT_REACHED, 0.0)],
)
def test_the_outcome_is_that_of_the_last_force(force_n, result, overshoot_n) -> None:
    step = GripStep(SETTINGS, Control(force_n), STAIRS)
    step.step(MOMENT)
    outcome = step.outcome(make_state(2.0))
    assert (outcome.result, outcome.final_force_n) == (result, force_n)
    assert outcome.overshoot_n == pytest.approx(overshoot_n)
    assert (outcome.contact_t_s, outcome.ended_early) == (None, False)


def test_a_hold_ends_in_time() -> None:
    control = Control(2.0)
    control.grip = SimpleNamespace(setpoint_n=2.0, force_n=2.0)
    step = HoldStep(GripperSettings(), control, 0.1)
    done = [step.step(MOMENT).done for _ in range(20)]
    assert done == [False] * 19 + [True]
