"""The loop: stalls, silence of pads and servos, and the bus that counts as lost."""

from math import inf

import numpy as np
import pytest

from gripper.errors import ForceAboveCap, ForceSensorStale
from gripper.force.estimates.grip import History
from gripper.force.ramp import ForceRamp
from gripper.force.timing import Histogram, LoopTimer
from gripper.values.outcome import GraspResult
from gripper.values.state import Cycle, GripperPhase
from simulator.servo.faults import Chatter

RAMP = ForceRamp.linear(8.0, rate_n_s=5.0, hold_s=0.3)


@pytest.mark.parametrize("dies", [False, True])
def test_a_stall_of_the_loop_is_no_silence_of_the_pads(make_started, dies) -> None:
    cell = make_started(stall_max_s=0.2)
    newest = cell.sensor.latest_force

    def stall() -> None:
        old, end_s = newest(), cell.clock.monotonic() + (inf if dies else 0.1)
        # What receives stands still, too.
        cell.sensor.latest_force = lambda: old if cell.clock.monotonic() < end_s else newest()
        cell.clock.sleep(0.09)

    observe = cell.once(stall, at_n=5.0)
    if not dies:
        assert cell.gripper.grasp(RAMP, observe).result is GraspResult.FORCE_REACHED
        return
    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP, observe)
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.1 + 0.09 + 0.01


def test_no_sensor_no_approach(cell) -> None:
    cell.sensor.dead = True
    cell.gripper.start()
    before_m = cell.mechanics.aperture_m
    with pytest.raises(ForceSensorStale):
        cell.gripper.grasp(RAMP)
    assert before_m - cell.mechanics.aperture_m < 0.003


@pytest.mark.parametrize("lost", [0, 1])
def test_a_pause_is_no_part_of_the_time_of_three_lost_answers(cell, lost: int) -> None:
    cell.hold_part(RAMP)
    cell.gripper.hold_at(8.0)
    cell.device.faults.drop_next = 9
    for period in range(6):
        cell.clock.sleep(0.09 if period == lost else 0.0)
        cell.gripper.tick()
    assert cell.gripper.fault is None
    assert cell.gripper.statistics.missed_reads >= 3


@pytest.mark.parametrize(
    ("knob", "value", "error"), [("gain", 3.0, ForceAboveCap), ("dead", True, ForceSensorStale)]
)
def test_pads_are_watched_while_servos_are_not_understood(make_started, knob, value, error) -> None:
    cell = make_started(bus_loss_s=2.0, force_max_n=9.0)

    def fail() -> None:
        cell.device.faults.chatter = Chatter(data=b"\xa5", every_s=0.0003)
        setattr(cell.sensor, knob, value)

    with pytest.raises(error):
        cell.gripper.grasp(RAMP, cell.once(fail, at_n=5.0))
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.2
    assert cell.gripper.statistics.missed_reads > 5


# -- Timing: histograms in bounded memory, stalls and overruns -------------------------------------


def test_quantiles_are_right_to_a_bin() -> None:
    durations_s = 10.0 ** np.random.default_rng(7).uniform(-5.5, 0.5, 20_000)
    histogram = Histogram()
    for duration_s in durations_s:
        histogram.add(float(duration_s))
    distribution = histogram.distribution()
    assert distribution.n == 20_000
    shown_s = np.array([distribution.p50_s, distribution.p99_s, distribution.p999_s])
    over = shown_s / np.quantile(durations_s, (0.5, 0.99, 0.999))
    assert 1.0 / 1.005 <= over.min() <= over.max() <= 1.08
    assert distribution.max_s == durations_s.max()


def test_overruns_in_a_row_end_with_a_period_in_time() -> None:
    timer = LoopTimer(0.005)
    timer.work_done(0.001, counts=True)
    timer.work_done(0.001, counts=False)
    timer.work_done(0.001, counts=True)
    assert timer.overruns_in_row == 2
    timer.work_done(0.0, counts=True)
    assert timer.overruns_in_row == 0
    assert timer.statistics().overruns == 3


@pytest.mark.parametrize(("stall_s", "times"), [(0.008, 5), (0.050, 1), (0.2, 1)])
def test_a_ramp_never_catches_up_with_a_jump(make_started, stall_s: float, times: int) -> None:
    cell = make_started(watchdog_s=0.4, rate_hz=200.0, noise_n=0.1, overruns_max=6)
    setpoints_n: list[float] = []

    def observe(cycle: Cycle) -> None:
        if cycle.setpoint_n > 0.0:
            setpoints_n.append(cycle.setpoint_n)
        if cycle.setpoint_n > 3.0 and len(stalled_n) < times:
            stalled_n.append(cycle.setpoint_n)
            cell.clock.sleep(stall_s)

    stalled_n: list[float] = []
    cell.gripper.grasp(RAMP, observe)
    assert max(np.diff(setpoints_n)) <= 5.0 * 2.0 * cell.gripper.settings.period_s + 1e-9
    assert setpoints_n[-1] == 8.0
    assert cell.peak_n <= 8.8
    statistics = cell.gripper.statistics
    assert statistics.overruns == statistics.late == times
    assert statistics.lateness.max_s == pytest.approx(stall_s, abs=0.006)


@pytest.mark.parametrize(("stiffness_n_m", "at_s"), [(1e3, 0.08), (2000.0, 0.05), (5000.0, 0.08)])
def test_the_force_is_known_after_a_stall_on_a_ramp(make_started, stiffness_n_m, at_s) -> None:
    """A push that goes on for 50 ms moves the part by much more than in one period."""
    cell = make_started(stiffness_n_m=stiffness_n_m, noise_n=0.02, rate_hz=200.0)
    times_s: list[float] = []
    errors_n: list[float] = []

    def stall(cycle: Cycle) -> None:
        if cycle.phase is not GripperPhase.RAMPING:
            return
        times_s.append(cycle.t_s)
        if max(np.diff(times_s), default=0.0) > 0.05:
            errors_n.append(abs(cell.gripper._grasping.control.grip.force_n - cell.force_n))
        elif cycle.t_s - times_s[0] >= at_s:
            cell.clock.sleep(0.05)

    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=20.0, hold_s=0.3), stall)
    assert outcome.result is GraspResult.FORCE_REACHED
    # Two periods later there is a sample from after the stall.
    assert max(errors_n[2:]) < 2.0


def test_values_are_kept_for_a_time_and_one_after_all_of_them_has_the_newest() -> None:
    drives = History()
    for tick in range(1024):
        drives.add(tick / 1024, 1024.0 - tick)
    assert [drives.most(since_s=t_s) for t_s in (0.5, 0.75, 1.25)] == [512.0, 256.0, 1.0]
    assert drives.at(0.5) == 512.0
