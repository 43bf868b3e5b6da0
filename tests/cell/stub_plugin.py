"""A stub of `TactileCellPlugin`: the table of states, without devices, time and threads.

A job is over as it is started, unless the test has paused it: that one runs until the test lets it
go on or fail, or a client holds it.
"""

import time
from dataclasses import replace
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from cell.control.live import LiveValues
from cell.control.part import Part, Verification
from cell.control.states import CellState, Command, GraspState, command_effect, refusal
from cell.errors import CellStateError, CellStopped, RequestRefused
from cell.fault_catalogue import error_text, fault_number
from cell.runtime.goals import TASKS, Goal, GripGoal, IdentifyGoal, TeachGoal, VerifyGoal
from cell.runtime.parts import OnPart
from cell.runtime.plugin import HostStatus
from cell.runtime.worker import Job, JobOutcome
from recognition.recognizer import UNKNOWN
from tests.values import make_shape

GRIP_N = 3.25
"""Force of the stub on a part, in N."""
ROUND = make_shape("sphere", 9.5, half_mm=0.5, dimensions_m={"diameter": 9.5e-3})
"""Shape of each part."""
FLAT = {"shape": "flat", "size_mm": 2.0}
"""Shape of an object that is taught."""
CURVES = {
    "t_s": [0.0, 1.0, 2.0], "force_n": [0.0, 1.0, 7.6], "setpoint_n": [0.0, 1.0, 7.5],
    "opening_mm": [18.0, 9.5, 9.4], "frame": [0.1] * 408,
}  # fmt: skip
"""Last grasp of each part."""
GRASP = SimpleNamespace(
    cycles=(SimpleNamespace(setpoint_n=5.0),), outcome=SimpleNamespace(final_force_n=4.9)
)
"""Record of each grasp."""
FOUND = Verification(held=True, same=True, force_n=GRIP_N, opening_m=9.5e-3)
"""Answer of each grip and verify."""


class StubPlugin:
    """A cell that does as it is asked."""

    def __init__(self, listed: tuple[str, ...] = ()) -> None:
        self.listed = listed
        self.objects: dict[str, dict[str, Any]] = {
            label: {"n_grasps": 5, "shape": "sphere", "size_mm": 9.5} for label in ("ball", "box")
        }
        """The taught objects by label."""
        self.taught_revision = 0
        self.finds = ""
        """What the next part is named; as it is presented where it is empty."""
        self.newtons = SimpleNamespace(
            of=lambda counts: counts.astype(np.float32), curves=lambda _record: CURVES
        )
        self.levels: dict[str, Any] = {
            "servos": {"level": "ok", "temperature_c": [41.0, 40.0], "load": [0.18, 0.2]}
        }
        """Health."""
        self.asked: list[Goal | tuple[str, bool]] = []
        """What was accepted: goals, and commands with their ``reboot``."""
        self.remarks: list[tuple[str, str]] = []
        self._jobs: list[Job] = []
        self._end: tuple[CellState, bool, Any] = (CellState.IDLE, False, None)
        self._paused = self._closed = False
        self._last_answer: Part | None = None
        self._part_numbers = count(1)
        self._error: Exception | None = None
        self.recording_path: Path | None = None
        self.working = True
        self._show(CellState.IDLE, holding=False)

    # -- what tests do -------------------------------------------------------------------------

    def pause(self) -> None:
        """Have the next job run until `go_on` or `fail`."""
        self._paused = True

    def report(self, **progress: Any) -> None:
        """Have the job that runs report so much more."""
        self._set(progress=self.job().progress | progress)

    def report_part(self, part: Part) -> None:
        """Have the job that runs report a part."""
        self._set(part=part)

    def ready(self) -> None:
        """Be idle with empty fingers, whatever was before; the job that runs is cancelled."""
        self._error = None
        self._over(JobOutcome.CANCELED, CellState.IDLE, holding=False)

    def go_on(self) -> None:
        """Let the job that runs, if any, succeed."""
        if (job := self._running) is not None:
            state, holding, value = self._end
            if isinstance(value, Part):
                now = {"job": job.number, "number": next(self._part_numbers), "seconds": 9.4}
                known = {"label_id": self.label_id(value.label), "time_s": time.time()}
                value = self._last_answer = value.model_copy(update=now | known)
                self.on_part(value, SimpleNamespace(records=[GRASP]))
                self._set(part=value)
            elif isinstance(value, Verification):
                self._set(verification=value)
            if isinstance(self._goal, TeachGoal):
                taught = self.objects.setdefault(self._goal.label, {"n_grasps": 0, **FLAT})
                taught["n_grasps"] += self._goal.grasps
                self.taught_revision += 1
            self._over(JobOutcome.SUCCEEDED, state, holding=holding, value=value)

    def fail(self, error: Exception) -> None:
        """Have a fault: the job that runs ends with it, and the grip is kept."""
        self._error = error
        self._over(JobOutcome.ABORTED, CellState.ABORTED, error=error_text(error), exception=error)

    def show_live(self, live: LiveValues) -> None:
        """Have these live values until the next change of state."""
        self._status = replace(self._status, live=live)

    def stop_recording(self, why: str) -> None:
        """Have a recording that has stopped, until the next change of state."""
        self._status = replace(self._status, recording_fault=why)

    # -- what the service asks -----------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        return {"name": "stub", "simulated": True, "n_taxels": 408, "labels": self.labels_by_id}

    def status(self) -> HostStatus:
        return self._status

    def watch_parts(self, on_part: OnPart) -> None:
        self.on_part = on_part

    @property
    def labels(self) -> tuple[str, ...]:
        return tuple(self.objects)

    @property
    def labels_by_id(self) -> tuple[str, ...]:
        return (*self.listed, *(label for label in self.objects if label not in self.listed))

    def label_id(self, label: str) -> int:
        labels = self.labels_by_id
        return labels.index(label) + 1 if label in labels else 0

    def taught(self) -> list[dict[str, Any]]:
        return [
            {"label": label, "label_id": self.label_id(label)} | values
            for label, values in self.objects.items()
        ]

    def forget(self, label: str, *, last: bool) -> Job:
        self.taught_revision += 1
        self.objects[label]["n_grasps"] -= 1
        if not last:
            del self.objects[label]
        return self._accept(("forget", last), Command.GRASP, CellState.EXECUTE, self._end)

    def forget_drift(self) -> Job:
        return self._accept(("forget_drift", False), None, self._cell, (self._cell, False, None))

    def health(self) -> dict[str, Any]:
        return self.levels

    def check(self, task: str) -> None:
        goal = task in TASKS
        command = {"grip": Command.GRIP, "verify": Command.VERIFY}.get(task, Command.GRASP)
        self._check(command if goal else self._needed(Command(task)))

    def job(self, number: int | None = None) -> Job:
        if number is None:
            return self._jobs[-1] if self._jobs else Job()
        if not 1 <= number <= len(self._jobs):
            raise RequestRefused(f"there is no job {number}; the newest is {len(self._jobs)}")
        return self._jobs[number - 1]

    def jobs(self) -> tuple[Job, ...]:
        return tuple(self._jobs)

    @property
    def _running(self) -> Job | None:
        return None if not self._jobs or self._jobs[-1].terminal else self._jobs[-1]

    def _set(self, **fields: Any) -> None:
        self._jobs[-1] = self._jobs[-1].model_copy(update=fields)

    def remark(self, kind: str, text: str) -> None:
        self.remarks.append((kind, text))

    def start(self, goal: Goal) -> Job:
        command, value, keeps = Command.GRASP, None, False
        if isinstance(goal, IdentifyGoal):
            label, keeps = self.finds or goal.present or "ball", goal.keep != "never"
            found = {UNKNOWN: 0.1, label: 0.9}
            value = Part(label=label, probabilities=found, n_grasps=1, in_grip=keeps, shape=ROUND)
        elif isinstance(goal, GripGoal | VerifyGoal):
            command, value, keeps = Command(goal.task), FOUND, True
        end = CellState.COMPLETE if keeps else CellState.IDLE
        return self._accept(goal, command, CellState.EXECUTE, (end, keeps, value))

    def start_command(
        self, command: Command, *, reboot: bool = False, needless: bool = False
    ) -> Job:
        state, holding = self._cell, self._status.holding
        needed: Command | None = self._needed(command)
        path = command_effect(state, needed).path or (state,)
        if needless and not command_effect(state, needed).accepted:
            needed = None
        end = CellState.IDLE if command is Command.RESET else path[-1]
        keeps = holding and command is not Command.RELEASE
        return self._accept((command, reboot), needed, path[0], (end, keeps, None))

    def _needed(self, command: Command) -> Command:
        if command is Command.RELEASE and self._cell in (CellState.RESETTING, CellState.STOPPED):
            return Command.RELEASE_HELD
        if command is Command.RESET and self._cell is CellState.STOPPED:
            return Command.START
        return command

    def _check(self, needed: Command | None) -> None:
        if self._closed:
            raise CellStateError("the cell is closed")
        if self._running is not None:
            raise CellStateError(f"job {self._running.number} is not over")
        if needed is not None and not command_effect(self._cell, needed).accepted:
            raise CellStateError(refusal(self._cell, needed))

    def cancel(self, job: Job, reason: str) -> None:
        if (running := self._running) is not None and job.number == running.number:
            stop = CellStopped(f"stopped {reason}")
            self._over(JobOutcome.CANCELED, CellState.HELD, error=str(stop), exception=stop)

    def close(self, _timeout_s: float) -> None:
        self._closed = True

    def _accept(
        self,
        asked: Goal | tuple[str, bool],
        needed: Command | None,
        acting: CellState,
        end: tuple[CellState, bool, Any],
    ) -> Job:
        self._check(needed)
        self._goal = asked
        if isinstance(asked, IdentifyGoal):
            self._last_answer = None
        if needed is Command.CLEAR:
            self._error = None
        self._end = end
        task = asked.task if hasattr(asked, "task") else str(asked[0])
        number = len(self._jobs) + 1
        self._jobs.append(
            Job(number=number, task=task, outcome=JobOutcome.EXECUTING, since_s=time.time())
        )
        self._show(acting, holding=self._status.holding or acting is CellState.EXECUTE)
        if not self._paused:
            self.go_on()
        self._paused = False
        # At last: a test in another thread goes on as soon as it is there.
        self.asked.append(asked)
        return self.job(number)

    def _over(
        self, outcome: JobOutcome, state: CellState, *, holding: bool | None = None, **end: Any
    ) -> None:
        self._show(state, holding=self._status.holding if holding is None else holding)
        if self._running is not None:
            self._set(outcome=outcome, **end)

    def _show(self, state: CellState, *, holding: bool) -> None:
        """Set the states in one assignment: interfaces read them in threads of their own."""
        self._cell = state
        grasp = GraspState.HOLDING if holding else GraspState.IDLE
        live = LiveValues(
            force_n=GRIP_N if holding else 0.0,
            force_age_s=0.005,
            setpoint_n=GRIP_N if holding else 0.0,
            opening_mm=9.5 if holding else 40.0,
            temperature_c=31.0,
            counts=np.full(408, len(self._jobs), dtype=np.uint16),
            frame_age_s=0.02,
        )
        if state in (CellState.ABORTED, CellState.STOPPED):
            live = LiveValues()
        self._status = HostStatus(
            state=state.value,
            state_number=state.number,
            needs_reset=state.needs_reset,
            grasp=grasp.value,
            grasp_number=grasp.number,
            holding=holding,
            fault=None if self._error is None else error_text(self._error),
            fault_number=fault_number(self._error),
            live=live,
            last_answer=self._last_answer,
            fault_since_s=None if self._error is None else 1.0e9,
        )
