"""Timing of the loop: histograms in bounded memory, stalls and overruns."""

import numpy as np
import pytest

from gripper.force.ramp import ForceRamp
from gripper.force.timing import Histogram, LoopTimer
from gripper.values.state import Cycle

RATE_N_S = 5.0
RAMP = ForceRamp.linear(8.0, RATE_N_S, hold_s=0.1)


def test_quantiles_are_right_to_a_bin() -> None:
    durations_s = 10.0 ** np.random.default_rng(7).uniform(-5.5, 0.5, 20_000)
    histogram = Histogram()
    for duration_s in durations_s:
        histogram.add(float(duration_s))
    found = histogram.distribution()
    assert found.n == 20_000
    for share, value_s in ((0.5, found.p50_s), (0.99, found.p99_s), (0.999, found.p999_s)):
        exact_s = float(np.quantile(durations_s, share))
        assert exact_s <= value_s * 1.005
        assert value_s <= exact_s * 1.08
    assert found.max_s == durations_s.max()


@pytest.mark.parametrize(
    ("duration_s", "counted_s"), [(-1.0, 0.0), (0.0, 0.0), (5e-7, 5e-7), (1e4, 1e4)]
)
def test_the_shortest_and_longest_durations_count_too(duration_s, counted_s) -> None:
    histogram = Histogram()
    assert histogram.distribution().p99_s == 0.0
    histogram.add(duration_s)
    assert histogram.distribution().n == 1
    assert histogram.distribution().max_s == counted_s
    assert duration_s == 1e4 or histogram.distribution().p999_s == counted_s


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
    assert max(np.diff(setpoints_n)) <= RATE_N_S * 2.0 * cell.gripper.settings.period_s + 1e-9
    assert setpoints_n[-1] == 8.0
    assert cell.peak_n <= 8.8
    statistics = cell.gripper.statistics
    assert statistics.overruns == statistics.late == times
    assert statistics.worst_lateness_s == pytest.approx(stall_s, abs=0.006)
    assert statistics.lateness.max_s == statistics.worst_lateness_s


def test_transactions_and_the_age_of_the_force_are_counted(cell) -> None:
    cell.hold_part(RAMP)
    statistics = cell.gripper.statistics
    assert statistics.transaction.n >= statistics.cycles
    assert 2e-4 < statistics.transaction.p50_s < 3e-3
    assert statistics.sensor_age.n > 100
    assert 0.0 < statistics.sensor_age.max_s < 0.06
    assert statistics.lateness.n == statistics.cycles
    assert statistics.lateness.max_s < 1e-6
