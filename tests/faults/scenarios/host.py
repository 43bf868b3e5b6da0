"""Faults of the host program: a slow loop, errors in its code, the wall clock."""

import time
from functools import cache
from typing import Any
from unittest import mock

import numpy as np

from cell.control.plan import Pose
from cell.control.records import GraspCollector, GraspRecord
from cell.control.states import CellState
from cell.errors import CellStateError
from cell.runtime.goals import TeachGoal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import JobFailed
from gripper.values.state import GripperPhase
from tests.faults.campaign import (
    CampaignCell,
    FaultRow,
    Observed,
    campaign_cell,
    campaign_config,
    observe,
)

_RATE_N_S = 10.0
"""Rate of the campaign's ramp."""
_BEYOND_N = 0.5
"""Force beyond its set-point that a gripper may have when its loop stands still."""

# -- 31: the loop is slow --------------------------------------------------------------------


class _HeldUp:
    """Holds up the force loop in the ramp, and looks whether it catches up afterwards."""

    def __init__(self, cell: CampaignCell, stall_s: float, times: int) -> None:
        self._cell = cell
        self._stall_s = stall_s
        self._left = times
        self._late = 0
        self._setpoint_n = 0.0
        self._add = GraspCollector.add
        self.ended_s: float | None = None
        self.began_s: float | None = None
        self.noted_s: float | None = None
        self.worst_step_n = self.worst_beyond_n = 0.0

    def add(self, collector: GraspCollector, cycle: Any, frames: Any) -> None:
        self._add(collector, cycle, frames)
        if self._setpoint_n > 0.0:
            self.worst_step_n = max(self.worst_step_n, cycle.setpoint_n - self._setpoint_n)
        self._setpoint_n = cycle.setpoint_n
        late = self._cell.controller.hand.statistics.loop.late
        if self.began_s is not None and self.noted_s is None and late > self._late:
            self.noted_s = self._cell.now_s
        if cycle.setpoint_n > 2.0 and self._left:
            if self.began_s is None:
                self.began_s, self._late = self._cell.now_s, late
            self._left -= 1
            self._cell.simulated.clock.sleep(self._stall_s)
            force_n = max(self._cell.simulated.world.contact_force_n())
            self.worst_beyond_n = max(self.worst_beyond_n, force_n - cycle.setpoint_n)
            self.ended_s = self.ended_s or self._cell.now_s


def loop_held_up(row: FaultRow, *, stall_s: float, times: int = 1) -> Observed:
    """Hold up the force loop of a grasp for so long, in so many periods in a row."""
    with campaign_cell(row.changes) as cell:
        held_up = _HeldUp(cell, stall_s, times)

        def add(collector: GraspCollector, cycle: Any, frames: Any) -> None:
            held_up.add(collector, cycle, frames)

        with mock.patch.object(GraspCollector, "add", add):
            seen = observe(cell)
        assert held_up.began_s is not None
        assert held_up.ended_s is not None
        if held_up.worst_step_n > _RATE_N_S * 2.0 * cell.controller.hand.period_s + 1e-9:
            jump = f"the set-point jumped by {held_up.worst_step_n:.2f} N"
            return Observed("CATCHES UP", None, jump)
        if held_up.worst_beyond_n > _BEYOND_N:
            beyond = f"the force rose to {held_up.worst_beyond_n:.2f} N beyond the set-point"
            return Observed("RAMP GOES ON", None, beyond)
        step = f"largest step of the set-point {held_up.worst_step_n:.2f} N"
        if seen.reaction == "NOTHING" and held_up.noted_s is not None:
            after_s = held_up.noted_s - held_up.ended_s
            return Observed("NOTE", after_s, f"counted as late; {step}; {seen.outcome}")
        latched_s = cell.monitor.latched_s
        after_s = None if latched_s is None else latched_s - held_up.began_s
        return Observed(seen.reaction, after_s, f"{seen.outcome}; {step}")


# -- 32: errors in the host's code -----------------------------------------------------------


def error_in_the_loop(row: FaultRow) -> Observed:
    """Let what collects the periods of the loop raise in the ramp."""

    def broken(_collector: GraspCollector, cycle: Any, _frames: Any) -> None:
        if cycle.setpoint_n > 1.0:
            raise RuntimeError("sink broken")

    def job(cell: CampaignCell) -> None:
        cell.start()
        try:
            cell.grasp()
        except RuntimeError as error:
            raise CellStateError(str(error)) from error

    with campaign_cell(row.changes) as cell, mock.patch.object(GraspCollector, "add", broken):
        seen = observe(cell, job=job)
        after_s = None if cell.monitor.latched_s is None else 0.0
        return Observed(seen.reaction if cell.grip_n > 0.2 else "LOST", after_s, seen.outcome)


def error_in_the_mover(row: FaultRow) -> Observed:
    """Teach through the plugin with a robot whose driver raises."""

    def broken(_pose: Pose) -> None:
        raise ZeroDivisionError("robot driver")

    with TactileCellPlugin(campaign_config(row.changes), mover=broken) as plugin:
        job = plugin.start(TeachGoal(label="ball", grasps=3))
        try:
            plugin.result(job, 30.0)
            end = "it was taught"
        except JobFailed as error:
            end = str(error)
        status = plugin.status()
        latched = status.state == CellState.ABORTED and status.fault is not None
        return Observed(
            "HOLD" if latched else "NOTHING",
            0.0,
            f"{end}; {status.state}, the fingers are open and empty",
        )


# -- 40: the wall clock ----------------------------------------------------------------------


def wall_clock_jumps(_row: FaultRow, *, step_s: float) -> Observed:
    """Grasp without and with a jump of the wall clock in the ramp, and compare all values."""
    before, before_s = _grasp_with_clock(0.0)
    jumped, jumped_s = _grasp_with_clock(step_s)
    same = (
        np.array_equal(before.grasp.counts, jumped.grasp.counts)
        and before.cycles == jumped.cycles
        and before_s == jumped_s
    )
    return Observed(
        "NOTHING" if same else "DIFFERENT",
        None,
        "each frame and each period of the loop is the same as without the jump; the recording "
        "has both clocks at its start and at each change of state",
    )


@cache
def _grasp_with_clock(step_s: float) -> tuple[GraspRecord, float]:
    """Return a grasp during which the wall clock jumps, and how long it took in s."""
    offset_s = [0.0]
    now, now_ns = time.time, time.time_ns

    def jumping_s() -> float:
        return now() + offset_s[0]

    def jumping_ns() -> int:
        return now_ns() + int(offset_s[0] * 1e9)

    with (
        mock.patch("time.time", jumping_s),
        mock.patch("time.time_ns", jumping_ns),
        campaign_cell() as cell,
    ):
        jumped = cell.once_in(
            GripperPhase.RAMPING, lambda: offset_s.__setitem__(0, step_s), after_s=0.1
        )
        cell.start()
        record = cell.grasp()
        assert jumped
        return record, cell.now_s
