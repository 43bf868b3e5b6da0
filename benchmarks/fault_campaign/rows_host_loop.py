"""Rows 31 and 32: the force loop is held up, the code of others raises."""

from typing import Any
from unittest import mock

import numpy as np

from benchmarks.fault_campaign.host_jobs import PERIOD_S
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    CampaignCell,
    campaign_cell,
    campaign_config,
    observe,
)
from cell.collect import GraspCollector
from cell.errors import CellStateError
from cell.plugin import TactileCellPlugin, TeachGoal
from cell.pose import Pose
from cell.sequence import GraspStep
from cell.states import CellState
from recognition.recognizer import Posterior

OVERRUNS_MAX = campaign_config().loop.overruns_max
RATE_N_S = 10.0
"""Rate of the campaign's ramp."""


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
        self.worst_step_n = 0.0

    def add(self, collector: GraspCollector, cycle: Any, frames: Any) -> None:
        """Collect as always, then sleep."""
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
            self.ended_s = self.ended_s or self._cell.now_s


def _stalled(stall_s: float, *, times: int = 1) -> Observed:
    """Hold up the force loop of a grasp for so long, in so many periods in a row."""
    with campaign_cell() as cell:
        held_up = _HeldUp(cell, stall_s, times)

        def add(collector: GraspCollector, cycle: Any, frames: Any) -> None:
            held_up.add(collector, cycle, frames)

        with mock.patch.object(GraspCollector, "add", add):
            seen = observe(cell, lambda: None)
        assert held_up.began_s is not None
        assert held_up.ended_s is not None
        if held_up.worst_step_n > RATE_N_S * 2.0 * PERIOD_S + 1e-9:
            told = f"the set-point jumped by {held_up.worst_step_n:.2f} N"
            return Observed(reaction="CATCHES UP", detected_after_s=None, outcome=told)
        step = f"largest step of the set-point {held_up.worst_step_n:.2f} N"
        if seen.reaction == "NOTHING" and held_up.noted_s is not None:
            return Observed(
                reaction="NOTE",
                detected_after_s=held_up.noted_s - held_up.ended_s,
                outcome=f"counted as late; {step}; {seen.outcome}",
            )
        latched_s = cell.monitor.latched_s
        return Observed(
            reaction=seen.reaction,
            detected_after_s=None if latched_s is None else latched_s - held_up.began_s,
            outcome=f"{seen.outcome}; {step}",
        )


# -- 32: exceptions --------------------------------------------------------------------------


class _Sure:
    """A recogniser that is sure of its first label, or breaks."""

    name, labels, uses_aperture = "sure", ("ball", "box"), False

    def __init__(self, error: Exception | None = None) -> None:
        self._error = error

    def posterior(self, grasp: Any) -> Posterior:
        if self._error is not None:
            raise self._error
        return Posterior(labels=self.labels, probability=np.array([1.0 - 1e-9, 1e-9]), unknown=0.01)


_STEP = GraspStep(pose=Pose(), force_n=3.0)


def _after_grasp(recognizer: Any, on_grasp: Any = None) -> Observed:
    """Identify with a recogniser or a callback that breaks; both run between two grasps."""
    with campaign_cell() as cell:
        cell.start()
        error, told = None, ""
        try:
            found = cell.controller.identify(recognizer, [_STEP], on_grasp=on_grasp)
            told = f"{found.complaints[0]}; the answer is {found.label}"
        except ValueError as caught:
            error = f"the job fails with {type(caught).__name__}: {caught}; no label"
        state = cell.controller.state
        unharmed = state is CellState.IDLE and cell.controller.fault is None
        cell.grasp()
        return Observed(
            reaction="NOTE" if unharmed else "HOLD",
            detected_after_s=0.0,
            outcome=f"{error or told}; {state.value}, the next grasp works",
        )


def _break_callback(*_told: object) -> None:
    raise ValueError("window closed")


def _in_the_loop() -> Observed:
    def broken(self: GraspCollector, cycle: Any, _frames: Any) -> None:
        if cycle.setpoint_n > 1.0:
            raise RuntimeError("sink broken")

    def job(cell: CampaignCell) -> None:
        cell.start()
        try:
            cell.grasp()
        except RuntimeError as error:
            raise CellStateError(str(error)) from error

    with campaign_cell() as cell, mock.patch.object(GraspCollector, "add", broken):
        seen = observe(cell, lambda: None, job)
        latched_s = cell.monitor.latched_s
        return Observed(
            reaction=seen.reaction if cell.grip_n > 0.2 else "LOST",
            detected_after_s=None if latched_s is None else 0.0,
            outcome=seen.outcome,
        )


def _mover() -> Observed:
    def broken(_pose: Pose) -> None:
        raise ZeroDivisionError("robot driver")

    with TactileCellPlugin(campaign_config(), mover=broken) as plugin:
        job = plugin.start(TeachGoal(label="ball", grasps=3))
        try:
            plugin.result(job, 30.0)
            told = "it was taught"
        except CellStateError as error:
            told = str(error)
        status = plugin.status()
        latched = status.state == CellState.ABORTED and status.fault is not None
        return Observed(
            reaction="HOLD" if latched else "NOTHING",
            detected_after_s=0.0,
            outcome=f"{told}; {status.state}, the fingers are open and empty",
        )


def _rows() -> list[FaultRow]:
    rows = [
        FaultRow(
            row=31,
            variant=f"{stall_s * 1e3:.0f} ms stall",
            fault=f"the loop is held up for {stall_s * 1e3:.0f} ms in the ramp, once",
            injected="a sink that sleeps",
            reaction=reaction,
            limit_s=limit_s,
            run=lambda stall_s=stall_s: _stalled(stall_s),
        )
        for stall_s, reaction, limit_s in (
            (0.010, "NOTE", 2 * PERIOD_S),
            (0.050, "NOTE", 2 * PERIOD_S),
            (0.500, "HOLD", 0.500 + 2 * PERIOD_S),
        )
    ]
    rows.append(
        FaultRow(
            row=31,
            variant="overruns in a row",
            fault=f"each period takes 10 ms too long; {OVERRUNS_MAX} in a row are the limit",
            injected="a sink that sleeps, each time",
            reaction="HOLD",
            limit_s=(OVERRUNS_MAX + 2) * (0.010 + PERIOD_S),
            run=lambda: _stalled(0.010, times=1000),
        )
    )
    rows += [
        FaultRow(
            row=32,
            variant=variant,
            fault=fault,
            injected="an exception",
            reaction=reaction,
            limit_s=PERIOD_S,
            run=run,
        )
        for variant, fault, reaction, run in (
            (
                "callback",
                "the callback that is told of each grasp raises",
                "NOTE",
                lambda: _after_grasp(_Sure(), _break_callback),
            ),
            (
                "recogniser",
                "the recogniser raises",
                "NOTE",
                lambda: _after_grasp(_Sure(ValueError("no such feature"))),
            ),
            ("sink", "what collects the periods of the loop raises", "HOLD", _in_the_loop),
            ("mover", "the host's callback that moves the robot raises", "HOLD", _mover),
        )
    ]
    return rows


ROWS: tuple[FaultRow, ...] = tuple(_rows())
