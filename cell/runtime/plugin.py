"""The plugin: a cell for a host program, behind jobs that never block.

Found through the entry point ``tactile_cell`` of the group ``robot_cell.plugins``. The host moves;
the plugin grasps and identifies. Libraries for recognition, CAN and servos are loaded with the
first cell, not with this module.
"""

import os
import sys
import threading
import time
import warnings
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, wait as wait_for
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from unicodedata import normalize

from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.control.part import Part
from cell.control.plan import Pose
from cell.control.states import CellState, CellStatus, Command, is_allowed
from cell.errors import CellError, CellStateError, ConfigError, PartInGrip, RequestRefused
from cell.fault_catalogue import error_text
from cell.runtime.goals import (
    TASKS,
    GaugeGoal,
    Goal,
    GripGoal,
    IdentifyGoal,
    SortGoal,
    TeachGoal,
    checked_goal,
)
from cell.runtime.lease import Lease
from cell.runtime.worker import SIGNAL_LOOK_S, CellWorker, Job, JobFailed, JobOutcome, Report
from gripper.errors import ServoFault

if TYPE_CHECKING:
    from cell.control.controller import CellController
    from cell.control.positioner import CarryCallback
    from cell.hand.interface import LiveValues
    from cell.runtime.parts import OnPart
    from cell.simulation import SimulationRequests
    from gripper.clock import Clock
    from gripper.values.outcome import ReleaseReport
    from tactile.layout import TaxelLayout

_COMMAND_OF = dict.fromkeys(TASKS, Command.GRASP) | {"grip": Command.GRIP, "verify": Command.VERIFY}
"""First command of the controller in each task."""
_NAMING = ("identify", "sort")
"""Tasks that name parts: they clear the last answer."""
_CLOSE_S = 30.0
"""Time in s in which a job ends after a stop; longer waits are errors."""
_HEALTH_S = 0.5
"""Time in s for which the computed health is reused."""
_REMARKS_MAX = 1000
"""Most remarks that wait for the thread of the cell; the oldest are dropped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HostStatus(CellStatus):
    """States of cell and grip, live values and the last answer, for a host."""

    live: "LiveValues" = field(compare=False)
    """Present force, opening, temperature and taxels."""
    recording_fault: str = ""
    """Why the recording has stopped; empty while it is written or without a recording."""
    last_answer: Part | None
    """Part of the last identification, also after other jobs. None from the start of the next
    identification or sort until an identification succeeds."""


class TactileCellPlugin:
    """A cell for host programs without ROS.

    Calls return at once, except `result`, `release`, `clear`, `reset` and `close`,
    which wait up to their time-out. A fault or a cancelled job keeps the grip until `release`. A
    command that the state of the cell does not allow raises CellStateError at once.

    ``host_timeout_s`` in the config is the longest time without a call while a job runs. The job is
    then stopped, with the grip kept. Each call about jobs counts, `status` and `alive`; a job
    keeps its result.

    The thread of a plugin that is dropped without `close` closes it, with a ResourceWarning.
    """

    _closed = True

    def __init__(
        self,
        config: Path | str | CellConfig | None = None,
        *,
        mover: Callable[[Pose], Pose | bool | None] | None = None,
        places: "CarryCallback | None" = None,
        model: Path | str | None = None,
        folder: Path | None = None,
        save: Path | str | None = None,
        ask: Callable[[str], str] | None = None,
        start: bool = True,
        note: Callable[[str], None] = lambda _text: None,
    ) -> None:
        """Connect to the cell, verify the devices and take the zero of the taxels.

        Parameters
        ----------
        config
            Config file or value; None is the built-in simulated cell.
        mover
            Called with each pose of the sequence; moves there and returns None or True, False to
            refuse, or the pose reached instead.
        places
            Called by a sort with the `Destination` of the part in the grip; brings it there and
            returns None or True, or False to refuse. The part is released after that.
        model
            File of a taught model, written by `save` or ``tactile-cell model train``; without
            a model, teach first.
        folder
            Folder of the recording; None: no recording.
        save
            Model file that each teaching writes before its job succeeds, as `save` does. A write
            error aborts the job, but the taught model is in use. The write is repeated after each
            job that leaves the grip empty, and by `close`. None: no file. An existing file must be
            that of ``model``.
        ask
            As `cell.build.build_cell`.
        start
            False: `connect` or `reset` verifies the devices.
        note
            Gets messages for the operator, e.g. that the recording has stopped, from any thread.

        Raises
        ------
        ConfigError, ModelError, CellError
            Before any hardware is touched.
        gripper.errors.GripperError, tactile.errors.TactileError
            If a device is missing or differs from the config. A servo at fault, or a part that an
            earlier run left in the grip, does not raise: the cell is then ABORTED, and
            `status` has the reason. Use `clear` and `release`.
        """
        checked = (
            config
            if isinstance(config, CellConfig)
            else load_config(None if config is None else Path(config))
        )
        if mover is not None:
            checked = checked.model_copy(
                update={"positioner": checked.positioner.model_copy(update={"kind": "callback"})}
            )
        from cell.build import build_cell  # noqa: PLC0415
        from cell.learning.taught_model import TaughtModel  # noqa: PLC0415
        from cell.runtime import tasks  # noqa: PLC0415
        from cell.runtime.health import health_values  # noqa: PLC0415
        from cell.runtime.parts import TaxelNewtons  # noqa: PLC0415
        from cell.simulation import SimulationRequests  # noqa: PLC0415

        self._config, self._note = checked, note
        self._starting = threading.Lock()
        self._health = health_values
        self._levels: dict[str, Any] = {}
        self._health_s = -inf
        self.model = TaughtModel(checked, model)
        """What is taught; only the thread of the plugin changes it."""
        _check_save(save, model)
        self._file = tasks.ModelFile(self.model, None if save is None else Path(save))
        if save is not None:
            parent = next(parent for parent in Path(save).absolute().parents if parent.exists())
            if not (parent.is_dir() and os.access(parent, os.W_OK)):
                note(f"no teaching can be saved to {save} before {parent} is a writable folder")
        self.cell = build_cell(
            checked, folder=folder, mover=mover, places=places, ask=ask, note=note
        )
        """The cell itself; only the thread of the plugin moves it."""
        controller = self.cell.controller
        self.newtons = TaxelNewtons(checked, controller)
        """Converts counts of the taxels into forces."""
        self._tasks = tasks.Tasks(controller, self._file)
        self._parts = self._tasks.parts
        self._reading: threading.Thread | None = None
        self._remarks: deque[tuple[str, str]] = deque(maxlen=_REMARKS_MAX)
        self._worker = CellWorker(
            idle=self.cell.idle,
            idle_period_s=1.0 / checked.gripper.loop_rate_hz if self.cell.realtime else None,
            progressed_s=lambda: controller.life.progressed_s,
        )
        if start:
            try:
                self.connect()
            except BaseException:
                controller.life.cancel()
                self._worker.close(_CLOSE_S)
                self.cell.close()
                raise
        self._simulation = (
            None
            if self.cell.simulated is None
            else SimulationRequests(self.cell.simulated, self._worker.between_jobs)
        )
        self._ending = threading.Lock()
        self._lease = self._lease_of_host(checked.host_timeout_s)
        self._closed = False

    def _lease_of_host(self, timeout_s: float | None) -> Lease:
        """Return the lease of the host; its loss stops the job. None: it is never lost."""
        # Weak references: the thread of the lease must not keep a dropped cell alive.
        worker, life = weakref.ref(self._worker), weakref.ref(self.cell.controller.life)

        def lost(reason: str) -> None:
            working, watched = worker(), life()
            if working is not None and watched is not None and working.running:
                watched.cancel(reason)

        lease = Lease(timeout_s or inf, given=lambda _name: None, lost=lost)
        if timeout_s is not None:
            lease.watch(warnings.warn)
        return lease

    def connect(self) -> None:
        """Verify the devices and take the zero of the taxels; raises as the constructor.

        Raises CellStopped after `interrupt`.
        """
        self._worker.check_free()
        controller, done = self.cell.controller, Future[None]()

        def start() -> None:
            try:
                controller.start()
            except (ServoFault, PartInGrip):
                done.set_result(None)  # the fault is latched: `clear` and `release` follow
            except BaseException as error:
                done.set_exception(error)
            else:
                done.set_result(None)

        self._worker.between_jobs(start)
        while not done.done():
            wait_for((done,), SIGNAL_LOOK_S)
        done.result()

    # -- questions -----------------------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        """Return name, pads in the order of the layout, limits, forces, labels by id, places."""
        return cell_values(self._config, self.cell.controller.hand.layout) | {
            "labels": self.labels_by_id,
            "places": self._place_names(),
        }

    def _place_names(self) -> tuple[str, ...]:
        from cell.runtime.tasks import Places  # noqa: PLC0415

        try:
            return self._tasks.places().names
        except ConfigError:  # a taught part has no place: a sort is refused
            return Places(self._config, ()).names

    def watch_parts(self, on_part: "OnPart") -> None:
        """Call a function with the answer of each part and its grasps, and with each miss.

        It runs in the thread of the cell.
        """
        self._parts.listeners.append(on_part)

    def health(self) -> dict[str, Any]:
        """Return the levels of servos, CAN, loop, drift and recording, and figures behind them.

        They are at most `_HEALTH_S` old.
        """
        now_s = time.monotonic()
        if now_s - self._health_s >= _HEALTH_S:
            self._levels, self._health_s = (
                self._health(self._config, self.cell, self.model.drift),
                now_s,
            )
        return self._levels

    @property
    def working(self) -> bool:
        """Whether the thread of the cell makes progress in a job, or supervises the cell.

        A silent force loop ends both with a fault. A job may make no progress for `JOB_SILENT_S`.
        """
        return self._worker.working

    @property
    def recording_path(self) -> Path | None:
        """The recording, if one is made."""
        return self.cell.recording_path

    @property
    def labels_by_id(self) -> tuple[str, ...]:
        """Names by label id, from 1: ``serve.objects`` of the config, then other taught labels."""
        return self._parts.labels

    def status(self) -> HostStatus:
        """Return the states of cell and grip, the live values, and the last answer."""
        with self._lease.calling("the host"):
            controller = self.cell.controller
            return HostStatus(
                **asdict(controller.life.status),
                live=controller.live,
                recording_fault=self.cell.recording_fault or "",
                last_answer=self._parts.last,
            )

    def alive(self) -> None:
        """Count as a call of the host, and do nothing else; see ``host_timeout_s``."""
        with self._lease.calling("the host"):
            return

    def taught(self) -> list[dict[str, Any]]:
        """Return the taught objects as plain data: available grasps, shape and size in mm.

        Another thread reads missing shapes; they are None until then. `revision` of `model` changes
        with each.
        """
        with self._starting:
            if self.model.unread and not (self._reading and self._reading.is_alive()):
                read = self.model.read_shapes
                self._reading = threading.Thread(target=read, name="taught-shapes", daemon=True)
                self._reading.start()
        return [
            {
                "label": label,
                "label_id": self._parts.label_id(label),
                "n_grasps": n_grasps,
                "shape": None if shape is None else shape.kind,
                "size_mm": None if shape is None else 1e3 * shape.size_m,
            }
            for label, (n_grasps, shape) in self.model.objects().items()
        ]

    # -- jobs ----------------------------------------------------------------------------------

    def run(
        self,
        goal: Goal | Mapping[str, Any],
        *,
        on_progress: Callable[[Job], None] = lambda _job: None,
    ) -> Any:
        """Run a job to its end and return its result; raises the error that ended it.

        ``on_progress`` is called in the thread of the cell with the job after each report. Raises
        as `start`.
        """
        return self._finish(self.start(goal, on_progress=on_progress), None)

    def start(
        self,
        goal: Goal | Mapping[str, Any],
        *,
        on_progress: Callable[[Job], None] = lambda _job: None,
    ) -> Job:
        """Start a job and return it at once.

        A goal is a `TeachGoal`, `GaugeGoal`, `ZeroGoal`, `IdentifyGoal`, `GripGoal`, `VerifyGoal`
        or `SortGoal`, or a mapping with ``task`` ``teach``, ``gauge``, ``zero``, ``identify``,
        ``grip``, ``verify`` or ``sort`` and the fields of these.

        Raises
        ------
        ConfigError
            If the goal is of another kind, has unknown fields or values out of range, or if a
            taught part has no place for a sort. If the simulated cell does not have a named part.
        CellStateError
            If another job runs, the cell is not IDLE (for a verify: not COMPLETE) or is being
            closed, or nothing was taught yet. If nothing is between the fingers of the simulated
            cell and the goal names no part for it.
        """
        checked = checked_goal(goal)
        self._check_task(checked.task)
        if isinstance(checked, TeachGoal | GaugeGoal):
            self._worker.check_free()
        checked = self._with_part(checked)
        if isinstance(checked, GaugeGoal):
            self.model.check_gauge(checked.label)
        work = partial(getattr(self._tasks, checked.task), checked)
        if self._simulation is not None and isinstance(checked, TeachGoal | GaugeGoal):
            work = partial(self._simulation.named, checked.label, checked.present, work)
        return self._accept(work, _COMMAND_OF[checked.task], checked.task, on_progress)

    def _with_part(self, goal: Goal) -> Goal:
        """Return a goal with the parts for the simulated cell, which refuses unknown ones.

        A sort without a feed gets each object of the config.
        """
        config, simulation = self._config, self._simulation
        if (
            isinstance(goal, SortGoal)
            and not goal.feed
            and (config.simulated or config.brings_objects)
        ):
            feed = tuple(entry.label for entry in config.simulator.objects)
            goal = goal.model_copy(update={"feed": feed})
        if simulation is None or config.positioner.kind == "operator":
            return goal
        if isinstance(goal, TeachGoal | GaugeGoal):
            part = simulation.part_for(goal.label, goal.present)
            return goal.model_copy(update={"present": part})
        if isinstance(goal, SortGoal):
            simulation.check_parts(goal.feed)
        elif isinstance(goal, IdentifyGoal | GripGoal) and goal.present is not None:
            simulation.check_parts([goal.present])
        elif isinstance(goal, IdentifyGoal) and config.positioner.kind != "axes":
            self._worker.check_free()
            return goal.model_copy(update={"present": simulation.part_here()})
        return goal

    def check_free(self) -> None:
        """Raise CellStateError while a job runs, or if the cell is being closed."""
        self._worker.check_free()

    def check(self, task: str) -> None:
        """Raise the errors that `start` and `start_command` would raise now for any goal.

        Raises
        ------
        CellStateError, ConfigError
            As `start` and `start_command`.
        """
        self._worker.check_free()
        if task in _COMMAND_OF:
            self.cell.controller.life.check(_COMMAND_OF[task])
            self._check_task(task)
        else:
            self.cell.controller.life.check(self._needed(Command(task)))

    def _check_task(self, task: str) -> None:
        """Raise CellError if the config or the taught objects do not allow a task."""
        if task == "zero":
            self.cell.controller.zeros.check()
        elif task == "gauge":
            self.model.check_gauge()
        elif task in _NAMING:
            self.model.check_taught()
            if task == "sort":
                self._tasks.places()

    def _needed(self, command: Command) -> Command:
        """Return the controller's command for a host's command in the present state."""
        state = self.cell.controller.life.state
        if command is Command.RESET and state is CellState.STOPPED:
            return Command.START
        if command is Command.RELEASE and state in (CellState.RESETTING, CellState.STOPPED):
            return Command.RELEASE_HELD
        return command

    def forget(self, label: str, *, last: bool = False) -> Job:
        """Start to forget a taught object and return the job at once.

        Parameters
        ----------
        label
            The object.
        last
            Whether only its newest grasp is removed.

        Raises
        ------
        RequestRefused
            If it is not taught.
        CellStateError
            If the cell is not IDLE.
        ModelError, DatasetError
            If its grasps cannot be read from the file of the loaded model.
        """
        taught = self.model.objects()
        label = label if label in taught else normalize("NFC", label)
        if label not in taught:
            raise RequestRefused(f"{label!r:.80} is not taught")
        file = self._file

        def work(_report: Report) -> None:
            file.forget(label, last=last)

        return self._accept(work, Command.GRASP, "forget")

    def feedback(self, job: Job) -> Job:
        """Return a job as it is now; never waits.

        Raises CellStateError for a job of another plugin, as `result` and `cancel` do.
        """
        with self._lease.calling("the host"):
            return self._worker.status(job)

    def job(self, number: int | None = None) -> Job:
        """Return a job by its number, the newest by default.

        Raises RequestRefused if there is no such job, or it is not kept.
        """
        with self._lease.calling("the host"):
            return self._worker.job(number)

    def jobs(self) -> tuple[Job, ...]:
        """Return the newest jobs, at most `MOST_JOBS`, oldest first."""
        with self._lease.calling("the host"):
            return self._worker.jobs()

    def result(self, job: Job, timeout_s: float) -> Any:
        """Wait for a job and return its result.

        A `Part` of an identification, a `Verification` of a grip or a verify, a `SortAnswer` of a
        sort, a `Drift` of a gauge, a `SelfZero` of a zero, or the number of taught grasps.

        Raises
        ------
        TimeoutError
            If it does not end in time; it continues.
        JobFailed
            If it was cancelled or aborted, see ``outcome``. ``__cause__`` is the error that ended
            it, a `CellStopped` after a cancel.
        """
        with self._lease.calling("the host"):
            ended = self._worker.wait(job, timeout_s)
        if ended.outcome is not JobOutcome.SUCCEEDED:
            raise JobFailed(ended) from ended.exception
        return ended.value

    def cancel(self, job: Job, reason: str = "on request") -> None:
        """Stop a job; a held part stays held. Does nothing after the end of the job."""
        with self._starting:
            if not self.feedback(job).terminal:
                self.cell.controller.life.cancel(reason)

    def interrupt(self) -> None:
        """Stop the running job and each later job, before the program ends.

        A held part stays held. A signal handler may call it.
        """
        self.cell.controller.life.interrupt()

    # -- commands ------------------------------------------------------------------------------

    def start_command(
        self, command: Command, *, reboot: bool = False, needless: bool = False
    ) -> Job:
        """Start `release`, `clear`, `reset` or a shutdown as a job and return it at once.

        Parameters
        ----------
        command
            ``Command.RELEASE``, ``CLEAR``, ``RESET`` or ``SHUTDOWN``. After a shutdown the cell is
            STOPPED, a held part stays held, and `reset` starts the cell again.
        reboot
            As `clear`.
        needless
            Whether a clear is accepted when nothing of the cell needs it.

        Raises
        ------
        RequestRefused
            If it is another command.
        CellStateError
            If the state of the cell does not allow it, or another job runs.
        """
        controller = self.cell.controller
        if needless and not is_allowed(controller.life.state, command):
            return self._accept(lambda _report: None, None, command.value)
        stopped = controller.life.state is CellState.STOPPED

        def reset() -> None:
            if not stopped:
                controller.life.reset()
            controller.start()

        works: dict[Command, Callable[[], Any]] = {
            Command.RELEASE: controller.release,
            Command.RELEASE_HELD: controller.release_held,
            Command.CLEAR: lambda: controller.life.clear(reboot=reboot),
            Command.RESET: reset,
            Command.START: reset,
            Command.SHUTDOWN: controller.shutdown,
        }
        if command not in works:
            raise RequestRefused(f"{command} is no command of a host; see the tasks of `start`")
        needed = self._needed(command)
        return self._accept(lambda _report: works[needed](), needed, command.value)

    def release(self, timeout_s: float = 30.0) -> "ReleaseReport":
        """Let the part go and open the fingers; the only way to do so outside a sequence.

        After a fault: `clear`, then `release`, then `reset`. Raises the error of the command.
        Returns what was opened: a servo that is silent or at fault is left as it is, and the other
        finger opens alone.
        """
        report: ReleaseReport = self._finish(self.start_command(Command.RELEASE), timeout_s)
        return report

    def clear(self, timeout_s: float = 5.0, *, reboot: bool = False) -> None:
        """Acknowledge a latched fault, also one from loading; the grip stays as it is.

        ``reboot`` restarts servos that report a hardware error: a part that they still hold drops.
        A remaining fault is raised.
        """
        self._finish(self.start_command(Command.CLEAR, reboot=reboot), timeout_s)

    def reset(self, timeout_s: float | None = 60.0) -> None:
        """Verify the devices again after `clear`, and be ready.

        Raises and latches PartInGrip if the fault left a part in the grip: `clear` it, `release`
        the part, and `reset` again. Other faults are raised as they are.
        """
        self._finish(self.start_command(Command.RESET), timeout_s)

    def follow_real_time(self, speed: float = 1.0, clock: "Clock" = time) -> None:
        """Let the time of a simulated cell follow a real clock, for people who watch it.

        It starts between two jobs, or at once in a callback of one. Before, virtual time runs as
        fast as the machine allows, and stands still between two jobs. A real cell does not change.

        Parameters
        ----------
        speed
            Virtual seconds per real second; 0: as before the first call.
        clock
            The real clock.
        """

        def follow() -> None:
            self._worker.idle_period_s = self.cell.follow(clock, speed)

        if not self.cell.realtime:
            self._worker.between_jobs(follow)

    def simulate(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Send a request to the simulated cell and return its reply, also while a job runs.

        Examples: ``{"inject": "servo1.off"}`` and ``{"clear": "servo1.off"}`` begin and end a
        fault; ``{"place": "cylinder:diameter=8mm,length=20mm"}`` exchanges the part. See
        `simulator.realtime.process`.

        Raises
        ------
        RequestRefused
            If the request cannot be carried out, or the cell has real ports.
        CellStateError
            If the fingers hold the part to exchange: release it first. If the cell is busy: try
            again.
        """
        return self._simulated()(dict(request))

    def begin_simulation_reset(self) -> Job:
        """Start to make a simulated cell ready from any state, and return the job.

        It ends all faults of the simulation, clears a fault of the cell, opens the fingers and
        removes the part. Raises RequestRefused if the cell has real ports, CellStateError while a
        job runs.
        """
        simulation, controller = self._simulated(), self.cell.controller

        def work(_report: Report) -> None:
            simulation.end_faults()
            if controller.life.state is CellState.ABORTED:
                controller.life.clear(reboot=True)
            if controller.life.state in (CellState.RESETTING, CellState.STOPPED):
                controller.release_held()
            else:
                controller.release()
            simulation.empty()
            if controller.life.state is CellState.RESETTING:
                controller.life.reset()
            if controller.life.state is CellState.STOPPED:
                controller.start()

        return self._accept(work, None, "simulation_reset")

    def _simulated(self) -> "SimulationRequests":
        if self._simulation is None:
            raise RequestRefused("this cell has real ports: it is not simulated")
        if self._closed:
            raise CellStateError("the cell is closed; load the plugin again")
        return self._simulation

    def save(self, path: Path | str, *, followed: bool = False) -> None:
        """Write the taught model with its training set, so that it can be taught further.

        ``followed``: the model expects the drift that this program has followed, for the rest of a
        shift.

        Raises
        ------
        CellStateError
            If nothing was taught yet.
        ModelError, DatasetError
            If the file cannot be written.
        """
        self.model.save(path, followed=followed)

    def remark(self, kind: str, text: str) -> None:
        """Write an event into the recording, with the next job or its end."""
        if self.cell.recording_path is not None:
            self._remarks.append((kind, text))

    def train(self, timeout_s: float | None = None) -> None:
        """Train the model on all taught grasps, after jobs with ``TeachGoal.train`` off.

        A note names the objects that are left out, because they have too few grasps. Raises
        CellError if no object has enough; the grasps are kept. Raises ModelError or DatasetError if
        the model cannot be written.
        """
        file, note = self._file, self._note

        def work(_report: Report) -> None:
            file.due = True
            if few := file.model.train():
                note(f"left out for too few grasps: {', '.join(few)}; teach or forget them")
            file.write()

        self._finish(self._accept(work, None, "train"), timeout_s)

    def forget_drift(self) -> Job:
        """Start to reset the followed drift, e.g. after work on the sensors; return the job."""
        model = self.model
        return self._accept(lambda _report: model.forget_drift(), None, "forget_drift")

    def close(self, timeout_s: float = _CLOSE_S) -> None:
        """Stop the running job and disconnect; a held part stays held. A second call does nothing.

        Accepted jobs end as cancelled unless they were nearly done; further jobs are refused.

        Raises
        ------
        CellStateError
            If the thread of the cell calls this, as in ``on_progress``: a job cannot wait for its
            own end. Nothing changes.
        TimeoutError
            If the running job does not end in time, e.g. because the mover does not return. Jobs
            are refused from then on; call this again to disconnect.
        ModelError, DatasetError, RecordingError
            If the taught model cannot be written to ``save``, or a part of the recording is lost.
            Everything else has ended.
        """
        self._worker.check_outside()
        with self._ending:
            if self._closed:
                return
            self._lease.close()
            self._stop_jobs()
            self._worker.close(timeout_s)
            _write_remarks(self.cell.controller, self._remarks)
            self._closed = True
            try:
                self.cell.close()
            finally:
                if self._reading is not None:
                    self._reading.join()
                self._file.write()

    def __del__(self) -> None:
        if self._closed or sys.is_finalizing():
            return
        self._lease.end_watch()
        self._stop_jobs()
        self._worker.end(self.cell.close)
        warnings.warn(
            f"the plugin of the cell {self._config.name!r} was dropped without close",
            ResourceWarning,
            source=self,
            stacklevel=1,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def _stop_jobs(self) -> None:
        """Refuse further jobs first, then stop the accepted ones: a later job would run."""
        with self._starting:
            self._worker.refuse()
            self.cell.controller.life.cancel()

    def _finish(self, job: Job, timeout_s: float | None) -> Any:
        """Wait for a command and return its result, or raise its error."""
        with self._lease.calling("the host"):
            status = self._worker.wait(job, timeout_s)
        if status.exception is not None:
            raise status.exception
        return status.value

    def _accept(
        self,
        work: Callable[[Report], Any],
        command: Command | None,
        task: str,
        on_change: Callable[[Job], None] = lambda _job: None,
    ) -> Job:
        """Start a job if its command is allowed now; an earlier `cancel` does not stop it."""
        controller, remarks, file, parts = (
            self.cell.controller, self._remarks, self._file, self._parts,
        )  # fmt: skip

        def accepted() -> None:
            if command is not None:
                controller.life.check(command)
            controller.life.forget_cancel()
            if task in _NAMING:
                parts.last = None

        def recorded(report: Report) -> Any:
            _write_remarks(controller, remarks)
            end = "succeeded"
            try:
                return work(report)
            except BaseException as error:
                end = f"failed: {error_text(error)}"
                raise
            finally:
                _write_remarks(controller, remarks)
                controller.journal.note("job", f"{task} {end}")
                if not controller.life.holding:  # nothing to supervise meanwhile
                    with suppress(CellError):  # `close` tries last, and raises it
                        file.write()

        with self._lease.calling("the host"), self._starting:
            return self._worker.start(task, recorded, accepted=accepted, on_change=on_change)


def cell_values(config: CellConfig, layout: "TaxelLayout") -> dict[str, Any]:
    """Return name, pads in the order of the layout, limits and forces of a cell, as plain data."""
    gripper = config.gripper
    low_n, high_n = config.sequence.forces_n
    return {
        "name": config.name,
        "simulated": config.simulated,
        "n_taxels": layout.n_taxels,
        "pads": [
            {
                "name": pad.name,
                "finger": pad.finger,
                "face": pad.face,
                "inner": index in layout.gripping_pads,
                "rows": pad.rows,
                "columns": pad.columns,
                "first": layout.taxels_of(index).start,
                "pitch_mm": [1e3 * pad.pitch_x_m, 1e3 * pad.pitch_y_m],
            }
            for index, pad in enumerate(layout.pads)
        ],
        "opening_max_mm": gripper.aperture_open_mm,
        "force_cap_n": gripper.force_max_n,
        "contact_force_n": gripper.contact_force_n,
        "levels_n": [low_n, high_n],
    }


def _check_save(save: Path | str | None, model: Path | str | None) -> None:
    """Raise ConfigError if a teaching would replace a file that is not the loaded model."""
    if save is None or (model is not None and Path(save).resolve() == Path(model).resolve()):
        return
    if Path(save).exists():
        raise ConfigError(
            f"{save} exists, and a teaching would replace it: load it (`--model {save}`), or "
            "save to another file"
        )


def _write_remarks(controller: "CellController", remarks: deque[tuple[str, str]]) -> None:
    """Write remarks of other threads; only the thread of the cell writes the recording."""
    while remarks:
        controller.journal.note(*remarks.popleft())
