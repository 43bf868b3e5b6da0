"""Rows 31 to 42: the host, its files, its commands; here 31, 32, 35, 40 and 42."""

import re
import threading
import time
from collections.abc import Callable
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.fault_campaign import rows_files, rows_processes
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    CampaignCell,
    campaign_cell,
    campaign_config,
    grasp_job,
    observe,
)
from cell.collect import GraspCollector, GraspRecord
from cell.errors import CellStateError, CellStopped
from cell.plugin import TactileCellPlugin, TeachGoal
from cell.pose import Pose
from cell.sequence import GraspStep
from cell.states import CellState
from gripper.state import GripperPhase
from recognition.recognizer import Posterior

PERIOD_S = 1.0 / campaign_config().gripper.loop_rate_hz
OVERRUNS_MAX = campaign_config().loop.overruns_max
RATE_N_S = 10.0
"""Rate of the campaign's ramp."""
HOUR_S = 3600.0
HOST_TIMEOUT_S = 0.3


def once_in(
    cell: CampaignCell, phase: GripperPhase, act: Callable[[], object], *, after_s: float = 0.1
) -> list[float]:
    """Do something once, so long after a phase began; return the list that gets the time of it."""
    began: list[float] = []
    seen: list[float] = []

    def look(now_s: float) -> None:
        if not began and cell.controller.hand.phase is phase:
            seen.append(now_s)
            if now_s - seen[0] >= after_s:
                began.append(now_s)
                act()

    cell.simulated.clock.on_advance.append(look)
    return began


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


def _break_callback(_number: int, _record: GraspRecord, _posterior: Posterior) -> None:
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


# -- 35: the host is silent ------------------------------------------------------------------


def _silent_host() -> Observed:
    config = campaign_config(host_timeout_s=HOST_TIMEOUT_S)
    with TactileCellPlugin(config) as plugin:
        job = plugin.start(TeachGoal(label="ball", grasps=1000))
        threading.Event().wait(3.0 * HOST_TIMEOUT_S)
        status, state = plugin.feedback(job), plugin.state()
        if state == CellState.HELD:
            plugin.release()
        silent = re.search(r"host was silent for ([0-9.]+) s", status.error)
        return Observed(
            reaction="HOLD" if silent is not None else status.outcome.value,
            detected_after_s=None if silent is None else float(silent[1]),
            outcome=f"{state}, job {status.outcome.value}, readable later: {status.error[:90]}",
        )


# -- 40: the wall clock ----------------------------------------------------------------------


def _grasp_with_clock(step_s: float) -> tuple[GraspRecord, float]:
    """Grasp while the wall clock jumps in the ramp; return the record and how long it took."""
    offset_s = [0.0]
    now, now_ns = time.time, time.time_ns

    def jumping() -> float:
        return now() + offset_s[0]

    def jumping_ns() -> int:
        return now_ns() + int(offset_s[0] * 1e9)

    with (
        mock.patch("time.time", jumping),
        mock.patch("time.time_ns", jumping_ns),
        campaign_cell() as cell,
    ):
        jumped = once_in(cell, GripperPhase.RAMPING, lambda: offset_s.__setitem__(0, step_s))
        cell.start()
        record: GraspRecord = cell.grasp()
        assert jumped
        return record, cell.now_s


def _wall_clock(step_s: float) -> Observed:
    plain, plain_s = _grasp_with_clock(0.0)
    jumped, jumped_s = _grasp_with_clock(step_s)
    same = (
        np.array_equal(plain.grasp.counts, jumped.grasp.counts)
        and plain.cycles == jumped.cycles
        and plain_s == jumped_s
    )
    return Observed(
        reaction="NOTHING" if same else "DIFFERENT",
        detected_after_s=None,
        outcome="each frame and each period of the loop is the same as without the jump; the "
        "recording has both clocks at its start and at each change of state",
    )


# -- 42: commands out of order ---------------------------------------------------------------


def _refused(prepare: Callable[[CampaignCell], object], command: str) -> Observed:
    """Give a command in a state that does not allow it, and look at what it changed."""
    with campaign_cell() as cell:
        prepare(cell)
        return _refusal(cell, command)


def _refusal(cell: CampaignCell, command: str) -> Observed:
    def seen() -> tuple[Any, ...]:
        hand = cell.controller.hand
        return (cell.controller.state, hand.phase, repr(hand.statistics.servo_bus), cell.now_s)

    before = seen()
    try:
        getattr(cell.controller, command)()
    except CellStateError as error:
        same = seen() == before
        return Observed(
            reaction="REJECT" if same else "CHANGED",
            detected_after_s=0.0,
            outcome=f"{error}; nothing was sent",
        )
    return Observed(reaction="NOTHING", detected_after_s=None, outcome="it was carried out")


def _while_moving(command: str) -> Observed:
    with campaign_cell() as cell:
        refusals: list[Observed] = []
        once_in(cell, GripperPhase.RAMPING, lambda: refusals.append(_refusal(cell, command)))
        cell.start()
        cell.grasp()
        return refusals[0]


def _aborted(cell: CampaignCell) -> None:
    cell.simulated.inject("can.off@contact+0.2s")
    observe(cell, lambda: None)


def _cancelled(times: int, phase: GripperPhase, *, at_start: bool = False) -> Observed:
    with campaign_cell() as cell:

        def cancel() -> None:
            for _ in range(times):
                cell.controller.cancel()

        began = once_in(cell, phase, cancel, after_s=0.0 if at_start else 0.1)
        try:
            if at_start:
                cell.controller.start()
            else:
                grasp_job(cell)
        except CellStopped as stop:
            after_s = cell.now_s - began[0]
            state = cell.controller.state
            cell.idle(0.5)
            settled = state in (CellState.HELD, CellState.STOPPED)
            return Observed(
                reaction="HOLD" if settled else state.value,
                detected_after_s=after_s,
                outcome=f"{stop}; {state.value} ({cell.grip_n:.1f} N)",
            )
        return Observed(reaction="NOTHING", detected_after_s=None, outcome="it went on")


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
    rows += [
        FaultRow(
            row=35,
            variant="silent host",
            fault="the host that has loaded the plugin makes no call any more, mid-job",
            injected=f"no call for {HOST_TIMEOUT_S:g} s (host_timeout_s)",
            reaction="HOLD",
            limit_s=2.0 * HOST_TIMEOUT_S,
            run=_silent_host,
            real_time=True,
        ),
        *(
            FaultRow(
                row=40,
                variant=variant,
                fault="the wall clock jumps in the ramp",
                injected=f"{step_s:+g} s",
                reaction="NOTHING",
                limit_s=None,
                run=lambda step_s=step_s: _wall_clock(step_s),
            )
            for variant, step_s in (
                ("an hour on", HOUR_S),
                ("an hour back", -HOUR_S),
                ("NTP step", -0.4),
            )
        ),
    ]
    rows += [
        FaultRow(
            row=42,
            variant=variant,
            fault=f"`{command}` while the cell is {state}",
            injected=command,
            reaction="REJECT",
            limit_s=PERIOD_S,
            run=run,
        )
        for variant, command, state, run in (
            ("double start", "start", "IDLE", lambda: _refused(CampaignCell.start, "start")),
            (
                "release while moving",
                "release",
                "EXECUTE",
                lambda: _while_moving("release"),
            ),
            ("start while moving", "start", "EXECUTE", lambda: _while_moving("start")),
            ("shutdown while moving", "shutdown", "EXECUTE", lambda: _while_moving("shutdown")),
            ("reset without clear", "reset", "ABORTED", lambda: _refused(_aborted, "reset")),
            ("release without clear", "release", "ABORTED", lambda: _refused(_aborted, "release")),
        )
    ]
    rows += [
        FaultRow(
            row=42,
            variant=variant,
            fault=fault,
            injected="cancel",
            reaction="HOLD",
            limit_s=2 * PERIOD_S,
            run=run,
        )
        for variant, fault, run in (
            (
                "cancel during start",
                "the start is cancelled while the fingers open",
                lambda: _cancelled(1, GripperPhase.OPENING, at_start=True),
            ),
            (
                "cancel twice",
                "a grasp is cancelled twice in the ramp",
                lambda: _cancelled(2, GripperPhase.RAMPING),
            ),
        )
    ]
    return rows


ROWS: tuple[FaultRow, ...] = (*_rows(), *rows_files.ROWS, *rows_processes.ROWS)
