"""Timing of the loop: histograms in bounded memory, stalls and overruns."""

from typing import Any

import numpy as np
import pytest

from gripper.force.ramp import ForceRamp
from gripper.force.timing import Histogram, LoopTimer
from gripper.values.state import Cycle, GripperPhase

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


@pytest.mark.parametrize(("duration_s", "found_s"), [(-1.0, 0.0), (0.0, 0.0), (5e-7, 5e-7)])
def test_the_shortest_durations_are_counted_too(duration_s: float, found_s: float) -> None:
    histogram = Histogram()
    histogram.add(duration_s)
    assert histogram.distribution().n == 1
    assert histogram.distribution().p999_s == found_s


def test_a_duration_beyond_the_last_bin_is_kept_as_the_largest() -> None:
    histogram = Histogram()
    histogram.add(1e4)
    assert histogram.distribution().max_s == 1e4
    assert Histogram().distribution().p99_s == 0.0


def test_overruns_in_a_row_end_with_a_period_in_time() -> None:
    timer = LoopTimer(0.005)
    timer.work_done(0.001, counts=True)
    timer.work_done(0.001, counts=False)
    timer.work_done(0.001, counts=True)
    assert timer.overruns_in_row == 2
    timer.work_done(0.0, counts=True)
    assert timer.overruns_in_row == 0
    assert timer.statistics().overruns == 3


def grasp_with_stall(cell: Any, stall_s: float, *, times: int = 1) -> list[Cycle]:
    """Grasp, and hold up the loop in the middle of the ramp."""
    cell.gripper.start()
    cycles: list[Cycle] = []
    left = times

    def observe(cycle: Cycle) -> None:
        nonlocal left
        cycles.append(cycle)
        if cycle.phase is GripperPhase.RAMPING and cycle.setpoint_n > 3.0 and left:
            left -= 1
            cell.clock.sleep(stall_s)

    try:
        cell.gripper.grasp(RAMP, observe)
    finally:
        cell.cycles = cycles
    return cycles


@pytest.mark.parametrize("stall_s", [0.010, 0.050, 0.2])
def test_a_ramp_never_catches_up_with_a_jump(make_cell: Any, stall_s: float) -> None:
    cell = make_cell(watchdog_s=0.4, rate_hz=200.0, noise_n=0.1)
    cycles = grasp_with_stall(cell, stall_s)
    setpoints_n = [c.setpoint_n for c in cycles if c.setpoint_n > 0.0]
    assert max(np.diff(setpoints_n)) <= RATE_N_S * 2.0 * cell.gripper.settings.period_s + 1e-9
    assert setpoints_n[-1] == 8.0
    assert cell.peak_n <= 8.8
    statistics = cell.gripper.statistics
    assert statistics.overruns == 1
    assert statistics.late == 1
    assert statistics.worst_lateness_s == pytest.approx(stall_s, abs=0.006)
    assert statistics.lateness.max_s == statistics.worst_lateness_s


def test_fewer_overruns_in_a_row_only_count(make_cell: Any) -> None:
    cell = make_cell(overruns_max=6)
    cycles = grasp_with_stall(cell, 0.008, times=5)
    assert cycles[-1].setpoint_n == 8.0
    assert cell.gripper.statistics.overruns == 5


def test_transactions_and_the_age_of_the_force_are_counted(cell) -> None:
    cell.hold_part(RAMP)
    statistics = cell.gripper.statistics
    assert statistics.transaction.n >= statistics.cycles
    assert 2e-4 < statistics.transaction.p50_s < 3e-3
    assert statistics.sensor_age.n > 100
    assert 0.0 < statistics.sensor_age.max_s < 0.06
    assert statistics.lateness.n == statistics.cycles
    assert statistics.lateness.max_s < 1e-6
