"""Faults: the grip is kept, the fault latched, nothing is pushed on with."""

from dataclasses import replace

import pytest

from gripper.dynamixel.control_table import GOAL_CURRENT
from gripper.errors import (
    BusTimeout,
    ForceAboveCap,
    ForceSensorStale,
    LimitExceeded,
    MechanicsContradicted,
    ServoFault,
)
from gripper.force.ramp import ForceRamp
from gripper.force_sensor import ForceSample
from gripper.outcome import GraspResult
from gripper.servos.feedback import TickWatch
from gripper.servos.goals import GoalGuard, ServoGoal
from gripper.state import GripperPhase

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)


@pytest.mark.parametrize("dies", [False, True])
def test_a_stall_of_the_loop_is_no_silence_of_the_pads(make_cell, dies) -> None:
    cell = make_cell(stall_max_s=0.2)
    cell.gripper.start()
    newest = cell.sensor.latest_force
    stalled_s: list[float] = []

    def stall() -> None:
        old = newest()
        cell.sensor.latest_force = latest = lambda: old  # what receives stood still, too
        stalled_s.append(cell.clock.monotonic())
        cell.clock.sleep(0.09)
        if not dies:
            cell.sensor.latest_force = lambda: (
                latest() if cell.clock.monotonic() < stalled_s[0] + 0.1 else newest()
            )

    if not dies:
        result = cell.gripper.grasp(RAMP, cell.once(stall, at_n=5.0)).result
        assert result is GraspResult.FORCE_REACHED
        return
    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, cell.once(stall, at_n=5.0))
    assert cell.clock.monotonic() - stalled_s[0] < 0.1 + 0.09 + 0.01


def test_silent_servos_do_not_hold_up_the_report_of_another_fault(make_cell) -> None:
    """A supply that fails takes pads and servos at once; the pads are named first."""
    cell = make_cell(bus_loss_s=0.5)
    cell.gripper.start()

    def fail() -> None:
        cell.sensor.dead = True
        cell.device.faults.silent.update({1, 2})

    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=5.0))
    asked_s = cell.clock.monotonic()
    with pytest.raises(BusTimeout):
        cell.gripper.keep_grip()
    assert cell.clock.monotonic() - asked_s < 0.02


def test_no_sensor_no_approach(cell) -> None:
    cell.sensor.dead = True
    cell.gripper.start()
    before_m = cell.mechanics.aperture_m
    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP)
    assert before_m - cell.mechanics.aperture_m < 0.003


def test_a_dead_bus_is_given_up_in_bounded_time_and_the_grip_stays(cell) -> None:
    cell.gripper.start()
    times: list[float] = []

    def silence() -> None:
        times.append(cell.clock.monotonic())
        cell.device.faults.silent.update({1, 2})

    with pytest.raises(BusTimeout, match=r"a part may still be gripped.*no answer"):
        cell.gripper.grasp(RAMP, cell.once(silence, at_n=5.0))
    assert 0.06 < cell.clock.monotonic() - times[0] < 0.1
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT
    cell.clock.sleep(2.0)
    assert cell.force_n > 3.0
    transactions = cell.bus.statistics.transactions
    cell.gripper.keep_grip()
    assert cell.bus.statistics.transactions == transactions
    with pytest.raises(BusTimeout):
        cell.gripper.clear_fault()
    cell.gripper.close()
    assert cell.force_n > 3.0


def test_a_tick_finds_a_tripped_watchdog_too(cell) -> None:
    cell.hold_part(RAMP)
    cell.clock.sleep(1.0)

    def tick_for_a_while() -> None:
        for _ in range(4):
            cell.gripper.tick()

    with pytest.raises(ServoFault, match="watchdog"):
        tick_for_a_while()
    cell.gripper.tick()
    assert cell.force_n > 3.0


@pytest.mark.parametrize("first", [True, False])
def test_a_stuck_finger_is_reported(cell, monkeypatch, first) -> None:
    cell.gripper.start()
    if not first:
        cell.gripper.open(0.025)
    monkeypatch.setattr(type(cell.mechanics), "step", lambda *_, **__: None)
    with pytest.raises(
        MechanicsContradicted if first else ServoFault,
        match="blocked on its way" if first else r"stuck.*gripper.linkage",
    ):
        cell.gripper.open()


def test_the_guard_stands_beside_the_write(cell) -> None:
    cell.gripper.start()
    state = cell.gripper.open()
    guard = GoalGuard(cell.settings, cell.linkage)
    angles = [servo.angle_rad for servo in state.servos]
    good = [ServoGoal(angle_rad=angle - 0.01, current_a=0.2) for angle in angles]
    guard.check(good, state, state.t_s)
    with pytest.raises(LimitExceeded, match=r"goal current 0\.900"):
        guard.check([good[0], ServoGoal(angle_rad=angles[1], current_a=0.9)], state, state.t_s)
    with pytest.raises(LimitExceeded, match="goal angle"):
        guard.check([good[0], ServoGoal(angle_rad=1.4, current_a=0.2)], state, state.t_s)
    with pytest.raises(LimitExceeded, match=r"feedback is 0\.500 s old"):
        guard.check(good, state, state.t_s + 0.5)
    with pytest.raises(LimitExceeded, match="from 0 to"):
        guard.check([good[0], ServoGoal(angle_rad=angles[1], current_a=-0.1)], state, state.t_s)
    assert cell.bus.read(1, GOAL_CURRENT) >= 0


def test_a_force_above_the_cap_counts_while_it_is_young(cell) -> None:
    cell.gripper.start()
    state = cell.gripper.open()
    guard = GoalGuard(cell.settings, cell.linkage)
    goals = [ServoGoal(angle_rad=s.angle_rad - 0.01, current_a=0.2) for s in state.servos]
    most_n = cell.settings.force_max_n + 5.0
    guard.note_force(ForceSample(t_s=state.t_s, force_n=(most_n, most_n)))
    with pytest.raises(ForceAboveCap):
        guard.check(goals, state, state.t_s)
    late = replace(state, t_s=state.t_s + 2.0 * cell.settings.force_stale_s)
    guard.check(goals, late, late.t_s)


def test_a_current_that_makes_more_than_the_cap_is_refused(make_cell) -> None:
    cell = make_cell(force_max_n=6.0, current_max_a=0.8)
    cell.gripper.start()
    state = cell.gripper.open()
    goals = [ServoGoal(angle_rad=s.angle_rad - 0.05, current_a=0.5) for s in state.servos]
    with pytest.raises(LimitExceeded, match="force_max_n is 6"):
        GoalGuard(cell.settings, cell.linkage).check(goals, state, state.t_s)


def test_the_servos_own_clock_shows_old_answers_and_restarts() -> None:
    watch = TickWatch()
    assert watch.check(1, 32760, 0.0, 0.001) is None
    assert watch.check(1, 2, 0.010, 0.011) is None
    old = watch.check(1, 3, 0.040, 0.041)
    assert old is not None
    assert "old answer" in str(old)
    assert watch.check(1, 33, 0.041, 0.042) is None
    assert watch.check(1, 20000, 0.046, 0.047) is not None
    assert watch.check(1, 20005, 0.051, 0.052) is None
    assert watch.check(1, 1, 30.0, 30.001) is None
    assert watch.check(1, 31000, 30.01, 30.011) is not None
    watch.forget()
    assert watch.check(1, 7, 30.02, 30.021) is None


def test_a_pause_before_three_lost_answers_is_no_lost_bus(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.tick()
    cell.clock.sleep(0.09)
    cell.device.faults.drop.next_packets = 9
    for _ in range(6):
        cell.gripper.tick()
    assert cell.gripper.fault is None
    assert cell.gripper.statistics.missed_reads >= 3
