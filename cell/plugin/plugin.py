"""The plugin: a cell as a host program loads it, behind jobs that never block.

Found through the entry point ``tactile_cell`` of the group ``robot_cell.plugins``. The host moves;
the plugin grasps and answers what it held. Libraries for recognition, CAN and servos are loaded
with the first cell, not with this module.
"""

import sys
import threading
import time
import warnings
import weakref
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.control.states import CellState, Command, command_effect
from cell.errors import (
    CellError,
    CellStateError,
    ConfigError,
    HandLost,
    PartInGrip,
    RequestRefused,
)
from cell.fault_catalogue import error_text
from cell.plugin.answer import (
    Answer,
    FeltShape,
    HostStatus,
    SortAnswer,
    Verification,
)
from cell.plugin.goals import (
    TASKS,
    GaugeGoal,
    Goal,
    GripGoal,
    IdentifyGoal,
    SortGoal,
    TeachGoal,
    VerifyGoal,
    ZeroGoal,
    checked_goal,
)
from cell.plugin.lease import Lease
from cell.plugin.worker import CellWorker, Job, JobFailed, JobOutcome, JobStatus, Report
from gripper.errors import LinkTooSlow, ServoFault, VerificationFailed, fingers_left

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from cell.control.controller import CellController
    from cell.control.positioner import CarryCallback
    from cell.jobs.sort import Places
    from cell.plugin.part_report import OnPart
    from cell.simulation import SimulationRequests
    from gripper.clock import Clock
    from gripper.values.outcome import ReleaseReport
    from recognition.drift.grid import DriftGrid
    from recognition.grasp import Grasp
    from tactile.layout import TaxelLayout

__all__ = [
    "Answer",
    "FeltShape",
    "GaugeGoal",
    "GripGoal",
    "HostStatus",
    "IdentifyGoal",
    "JobFailed",
    "JobOutcome",
    "SortAnswer",
    "SortGoal",
    "TactileCellPlugin",
    "TeachGoal",
    "Verification",
    "VerifyGoal",
    "ZeroGoal",
]


_COMMANDS = dict.fromkeys(TASKS, Command.GRASP) | {"grip": Command.GRIP, "verify": Command.VERIFY}
"""Command of the controller that each task begins with."""
_NAMING = ("identify", "sort")
"""Tasks that name parts: an earlier answer is not that of their part."""
_REMARKS_MAX = 1000
"""Remarks that wait for the thread of the cell; the oldest go first."""


class TactileCellPlugin:
    """A cell for host programs without ROS.

    Calls return at once, but for `result`, `release`, `clear`, `reset`, `forget_drift` and `close`,
    which wait up to their time-out. A fault or a cancelled job keeps the grip; `release` is the
    only way to let go. A command that the state of the cell does not allow is refused at once with
    CellStateError.

    With ``host_timeout_s`` in the config a host that makes no call for so long while a job runs
    has the job stopped, with the grip kept. Any call counts, `alive` too; a job keeps its result.

    A plugin that is dropped without `close` is closed by its thread, with a ResourceWarning.
    """

    _closed = True

    def __init__(
        self,
        config: Path | str | CellConfig | None = None,
        *,
        mover: Callable[[Pose], Pose | bool | None] | None = None,
        places: "CarryCallback | None" = None,
        model: Path | str | None = None,
        training_set: Path | str | None = None,
        gauge: Path | str | None = None,
        gauge_shape: str | None = None,
        folder: Path | None = None,
        save: Path | str | None = None,
        capture: Path | None = None,
        ask: Callable[[str], str] | None = None,
        start: bool = True,
        note: Callable[[str], None] = lambda _text: None,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        """Connect to the cell, verify the devices and take the zero of the taxels.

        Parameters
        ----------
        config
            Config file or value; None is the built-in simulated cell.
        mover
            Called with each pose that the sequence wants the object at; returns None or True when
            it is reached, False to refuse, or the pose reached instead.
        places
            Called by a sort with the `Destination` of a part that the grip holds; brings it there
            and returns None or True, or False to refuse. The part is let go after that.
        model
            File of a taught model, as `save` or ``tactile-cell train`` writes it; without one,
            teach first.
        training_set
            Data set of the grasps that trained the model, needed to teach further objects; by
            default the one that `save` wrote beside it.
        gauge
            Data set or recording of grasps of one known object on this cell: shape and size are
            then read under the foam that it shows.
        gauge_shape
            Its shape, as ``sphere:diameter=9.5mm``; without it that of the configured object of
            the grasps' label.
        folder
            Where the recording goes; None makes none.
        save
            Model file that each teaching writes before its job succeeds, as `save` does. One that
            cannot be written aborts the job, though what was taught is in use, and is tried again
            after each job that leaves the grip empty, and by `close`. None writes none.
        capture, ask
            As `cell.build.build_cell`.
        start
            False: the devices are verified by `reset`, which raises all that is wrong with them.
        note
            Gets messages for the operator, as that the recording has stopped, from any thread.
        wall_s
            Returns the unix time in s, for the age of recordings and of the self-zero.

        Raises
        ------
        ConfigError, ModelError, DatasetError, CellError
            Before any hardware is touched.
        gripper.errors.GripperError, tactile.errors.TactileError
            If a device is missing or differs from the config. What `clear` and `release` may mend,
            a servo at fault or a part that an earlier run left in the grip, does not raise: the
            cell is then ABORTED, and `fault` returns why.
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
        from cell.learning.pad_knowledge import pad_knowledge  # noqa: PLC0415
        from cell.learning.taught_model import TaughtModel  # noqa: PLC0415
        from cell.plugin import tasks  # noqa: PLC0415
        from cell.plugin.health import health_values  # noqa: PLC0415
        from cell.plugin.part_report import TaxelNewtons, part_reporter  # noqa: PLC0415
        from cell.simulation import SimulationRequests  # noqa: PLC0415

        self._config = checked
        self._starting = threading.Lock()
        self._health = health_values
        known = pad_knowledge(checked, None if gauge is None else Path(gauge), gauge_shape)
        self._model = (
            TaughtModel(checked, known=known)
            if model is None
            else TaughtModel.load(checked, model, training_set=training_set, known=known)
        )
        self._file = tasks.ModelFile(self._model, None if save is None else Path(save))
        self._cell = build_cell(
            checked,
            folder=folder,
            mover=mover,
            places=places,
            capture=capture,
            ask=ask,
            note=note,
            wall_s=wall_s,
        )
        controller, file = self._cell.controller, self._file
        listeners: list[OnPart] = []
        newtons = TaxelNewtons(checked, controller)
        self._part_listeners, self._newtons = listeners, newtons
        self._reading: threading.Thread | None = None
        self._places: Callable[[], Places] = lambda: tasks.Places(checked, file.model.labels)
        self._tasks = tasks.Tasks(
            controller,
            file,
            self._places,
            lambda task: part_reporter(task, controller, newtons, listeners),
        )
        self._remarks: deque[tuple[str, str]] = deque(maxlen=_REMARKS_MAX)
        self._last_answer: deque[Answer] = deque(maxlen=1)
        self._interrupted = False
        try:
            if start:
                self._cell.controller.start()
        except (ServoFault, PartInGrip):
            # The fault is latched: `clear` and `release` are the way on.
            pass
        except BaseException:
            self._cell.close()
            raise
        self._worker = CellWorker(
            idle=self._cell.idle,
            idle_period_s=1.0 / checked.gripper.loop_rate_hz if self._cell.realtime else None,
        )
        self._simulation = (
            None
            if self._cell.simulated is None
            else SimulationRequests(self._cell.simulated, self._worker.between_jobs)
        )
        self._ending = threading.Lock()
        self._lease: Lease | None = None
        self._closed = False
        if checked.host_timeout_s is not None:
            # Weakly: the thread of the lease must not keep a cell that its host has dropped.
            worker, cell = weakref.ref(self._worker), weakref.ref(controller)

            def lost(reason: str) -> None:
                working, watched = worker(), cell()
                if working is not None and watched is not None and working.running:
                    watched.cancel(reason)

            self._lease = Lease(checked.host_timeout_s, given=lambda _name: None, lost=lost)
            self._lease.watch(warnings.warn)

    # -- questions -----------------------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        """Return name, pads in the order of the layout, limits, forces, taught labels, places."""
        return cell_values(self._config, self._cell.controller.hand.layout) | {
            "labels": self.labels,
            "places": self._place_names(),
        }

    def _place_names(self) -> tuple[str, ...]:
        from cell.jobs.sort import Places  # noqa: PLC0415

        try:
            return self._places().names
        except ConfigError:  # a taught part has no place yet; a sort is refused
            return Places(self._config, ()).names

    def watch_parts(self, on_part: "OnPart") -> None:
        """Have a function called with each part that is identified or sorted, and with each miss.

        It is called in the thread of the cell.
        """
        self._part_listeners.append(on_part)

    def health(self) -> dict[str, Any]:
        """Return the levels of servos, CAN, loop, drift and recording, and figures behind them."""
        return self._health(self._config, self._cell, self._model.drift)

    def counters(self) -> dict[str, Any]:
        """Return the counters of links, sensor, loop and recording as plain data."""
        return self._cell.health()

    @property
    def working(self) -> bool:
        """Whether the thread of the cell runs a job, or looks after the cell in each period.

        A force loop that is silent ends a job, and a look, with a fault.
        """
        return self._worker.working

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the operator: how the force loop runs, and why there is no self-zero."""
        return tuple(filter(None, (*self._cell.notes, self._cell.controller.zero_note)))

    @property
    def loop_text(self) -> str:
        """How punctual the force loop was; empty in virtual time."""
        from cell.control.journal import loop_line  # noqa: PLC0415

        hand = self._cell.controller.hand
        return loop_line(hand.statistics.loop, hand.period_s) if self._cell.realtime else ""

    def grip_left(self, error: BaseException) -> str:
        """Return what an error has left in the grip, as far as it is known, as text."""
        from cell.control.lifecycle import NO_GRIP  # noqa: PLC0415

        controller = self._cell.controller
        if left := fingers_left(error):
            return left
        if isinstance(error, HandLost):
            return "a part may still be gripped" if controller.holding else NO_GRIP[False]
        if isinstance(error, PartInGrip | VerificationFailed | LinkTooSlow):
            return "nothing was moved"
        return "the grip is kept" if controller.holding else NO_GRIP[controller.shows_nothing]

    def check_recording(self) -> None:
        """Raise RecordingError where something is lost of the recording."""
        self._cell.check_recording()

    @property
    def training_set(self) -> "tuple[Grasp, ...]":
        """The taught grasps, as far as they are at hand."""
        return self._model.training_set

    @property
    def trainer_name(self) -> str:
        """The recogniser of the model. Raises CellStateError before teaching."""
        return self._model.check_taught().trainer_name

    @property
    def drift(self) -> "DriftGrid | None":
        """The drift of the sensors since teaching; None where it is not followed."""
        return self._model.drift

    def newtons(self, counts: "NDArray[np.uint16]") -> "NDArray[np.float32] | None":
        """Return the force in N on each taxel by its counts; None before the first zero."""
        return self._newtons.of(counts)

    @property
    def recording_path(self) -> Path | None:
        """The recording, if one is made."""
        return self._cell.recording_path

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return self._model.labels

    def state(self) -> str:
        """Return the state of the cell, a PackML name."""
        with self._calling():
            return self._cell.controller.state.value

    def status(self) -> HostStatus:
        """Return the states of cell and grip, the live values, and the last answer."""
        with self._calling():
            controller = self._cell.controller
            return HostStatus(
                **asdict(controller.status),
                live=controller.live,
                recording_fault=self._cell.recording_fault or "",
                last_answer=next(iter(self._last_answer), None),
            )

    def fault(self) -> str | None:
        """Return the latched fault as text; None where there is none."""
        with self._calling():
            return self._cell.controller.fault

    def alive(self) -> None:
        """Count as a call of the host, and do nothing else; see ``host_timeout_s``."""
        with self._calling():
            return

    @property
    def taught_revision(self) -> int:
        """Changes of what is taught so far."""
        return self._model.revision

    def taught(self) -> list[dict[str, Any]]:
        """Return the taught objects as plain data: grasps at hand, shape and size in mm by one.

        Shapes that are not known yet are None, and are read in a thread of their own;
        `taught_revision` changes with each.
        """
        if not self._model.shapes_read and not (self._reading and self._reading.is_alive()):
            read = self._model.read_shapes
            self._reading = threading.Thread(target=read, name="taught-shapes", daemon=True)
            self._reading.start()
        return [
            {
                "label": label,
                "n_grasps": n_grasps,
                "shape": None if shape is None else shape.kind,
                "size_mm": None if shape is None else 1e3 * shape.size_m,
            }
            for label, (n_grasps, shape) in self._model.objects().items()
        ]

    # -- jobs ----------------------------------------------------------------------------------

    def run(
        self,
        goal: Goal | Mapping[str, Any],
        *,
        on_progress: Callable[[dict[str, Any]], None] = lambda _progress: None,
    ) -> Any:
        """Do a job to its end and return its result; what ends it otherwise is raised as it is.

        ``on_progress`` is called in the thread of the cell with each report. Raises as `start`.
        """
        return self._finish(self.start(goal, on_progress=on_progress), None)

    def start(
        self,
        goal: Goal | Mapping[str, Any],
        *,
        on_progress: Callable[[dict[str, Any]], None] = lambda _progress: None,
    ) -> Job:
        """Start a job and return its handle at once.

        A goal is a `TeachGoal`, `GaugeGoal`, `ZeroGoal`, `IdentifyGoal`, `GripGoal`, `VerifyGoal`
        or `SortGoal`, or a mapping with ``task`` ``teach``, ``gauge``, ``zero``, ``identify``,
        ``grip``, ``verify`` or ``sort`` and the fields of these.

        Raises
        ------
        ConfigError
            If the goal is none of these, has unknown fields or values out of range, or a taught
            part has no place to be sorted to.
        CellStateError
            If another job runs, the cell is not IDLE (for a verify: not COMPLETE) or is being
            closed, nothing was taught yet, or a model was loaded whose training set is not at hand:
            teaching would lose its objects. If nothing lies between the fingers of the simulated
            cell, and it has no object of the name to teach.
        """
        checked = checked_goal(goal)
        self._check_taught(checked.task)
        if (
            isinstance(checked, TeachGoal | GaugeGoal)
            and self._config.positioner.kind != "operator"
        ):
            self._worker.check_free()
            if self._simulation is not None:
                part = self._simulation.part_for(checked.label, checked.present)
                checked = checked.model_copy(update={"present": part})
        if isinstance(checked, GaugeGoal):
            self._model.check_gauge(checked.label)
        if isinstance(checked, ZeroGoal):
            self._cell.controller.check_zero()
        task = getattr(self._tasks, checked.task)

        def work(report: Report) -> Any:
            def reported(progress: dict[str, Any]) -> None:
                report(progress)
                on_progress(progress)

            return task(checked, reported)

        return self._accept(work, _COMMANDS[checked.task], checked.task)

    def check(self, task: str) -> None:
        """Raise what `start` and `start_command` would raise now, whatever the goal.

        Raises
        ------
        CellStateError, ConfigError
            As `start` and `start_command`.
        """
        self._worker.check_free()
        if task in _COMMANDS:
            self._cell.controller.check(_COMMANDS[task])
            self._check_taught(task)
        else:
            self._cell.controller.check(self._needed(Command(task)))

    def _check_taught(self, task: str) -> None:
        """Raise CellStateError or ConfigError where the taught objects do not allow a task."""
        if task == "teach":
            self._model.check_extendable()
        elif task in (*_NAMING, "gauge"):
            self._model.check_taught()
            if task == "sort":
                self._places()

    def _needed(self, command: Command) -> Command:
        """Return the command of the controller that a command of the host is in this state."""
        state = self._cell.controller.state
        if command is Command.RESET and state is CellState.STOPPED:
            return Command.START
        if command is Command.RELEASE and state in (CellState.RESETTING, CellState.STOPPED):
            return Command.RELEASE_HELD
        return command

    def forget(
        self, label: str, *, last: bool = False, forgotten: Callable[[], None] = lambda: None
    ) -> Job:
        """Start to forget a taught object and return the handle of the job at once.

        Parameters
        ----------
        label
            The object.
        last
            Whether its newest grasp alone is taken back.
        forgotten
            Called, in the thread of the cell, once nothing of the object is left.

        Raises
        ------
        CellStateError
            If it is not taught, its grasps are not at hand, or the cell is not IDLE.
        """
        self._model.check_extendable()
        if label not in self._model.labels:
            raise CellStateError(f"{label!r:.80} is not taught")
        file = self._file

        def work(_report: Report) -> None:
            file.forget(label, last=last, forgotten=forgotten)

        return self._accept(work, Command.GRASP, "forget")

    def feedback(self, job: Job) -> JobStatus:
        """Return state and progress of a job; never waits.

        Raises CellStateError for a job of another plugin, as `result` and `cancel` do.
        """
        with self._calling():
            return self._worker.status(job)

    def result(self, job: Job, timeout_s: float) -> Any:
        """Wait for a job and return its result.

        That is an `Answer` of an identification, a `Verification` of a grip or a verify, a
        `SortAnswer` of a sort, a `Drift` of a gauge, a `SelfZero` of a zero, and the number of
        grasps taught.

        Raises
        ------
        TimeoutError
            If it is not over in time; it goes on.
        JobFailed
            If it was cancelled or aborted: ``outcome`` names which, and ``__cause__`` is the error
            that ended it, a `CellStopped` for one that was cancelled.
        """
        with self._calling():
            status = self._worker.wait(job, timeout_s)
        if status.outcome is not JobOutcome.SUCCEEDED:
            raise JobFailed(job, status) from status.exception
        return status.value

    def cancel(self, job: Job, reason: str = "on request") -> None:
        """Stop a job; what is held stays held. Does nothing to a job that is over.

        A part that is kept is held already: nothing changes then.
        """
        with self._starting:
            if not self.feedback(job).outcome.terminal:
                self._cell.controller.cancel(reason)

    def interrupt(self) -> None:
        """Stop what runs, and each job that starts later, for a program that is to end.

        What is held stays held. A signal handler may call it.
        """
        self._interrupted = True
        self._cell.controller.cancel()

    # -- commands ------------------------------------------------------------------------------

    def start_command(
        self, command: Command, *, reboot: bool = False, needless: bool = False
    ) -> Job:
        """Start `release`, `clear`, `reset` or a shutdown as a job and return its handle at once.

        Parameters
        ----------
        command
            ``Command.RELEASE``, ``CLEAR``, ``RESET`` or ``SHUTDOWN``. After a shutdown the cell is
            STOPPED, what is held stays held, and `reset` starts it anew.
        reboot
            As `clear`.
        needless
            Whether a clear is accepted where nothing of the cell is to be cleared.

        Raises
        ------
        CellStateError
            If the state of the cell does not allow it, or another job runs.
        """
        controller = self._cell.controller
        if needless and not command_effect(controller.state, command).accepted:
            return self._accept(lambda _report: None, None, command.value)
        stopped = controller.state is CellState.STOPPED

        def reset() -> None:
            if not stopped:
                controller.reset()
            controller.start()

        works: dict[Command, Callable[[], Any]] = {
            Command.RELEASE: controller.release,
            Command.RELEASE_HELD: controller.release_held,
            Command.CLEAR: lambda: controller.clear(reboot=reboot),
            Command.RESET: reset,
            Command.START: reset,
            Command.SHUTDOWN: controller.shutdown,
        }
        needed = self._needed(command)
        return self._accept(lambda _report: works[needed](), needed, command.value)

    def release(self, timeout_s: float = 30.0) -> "ReleaseReport":
        """Let the part go and open the fingers; the only way to do so outside a sequence.

        Of a kept part too, where the host wants it.

        After a fault: `clear`, then `release`, then `reset`. What goes wrong is raised as it is.
        Returns what was opened: a servo that is silent or at fault is left as it is, and the other
        finger opens alone.
        """
        report: ReleaseReport = self._finish(self.start_command(Command.RELEASE), timeout_s)
        return report

    def clear(self, timeout_s: float = 5.0, *, reboot: bool = False) -> None:
        """Acknowledge a latched fault, one that was there at loading too; the grip stays as it is.

        With ``reboot`` servos that report a hardware error are restarted: what one of them still
        held would drop. A fault that is still there is raised as it is.
        """
        self._finish(self.start_command(Command.CLEAR, reboot=reboot), timeout_s)

    def reset(self, timeout_s: float | None = 60.0) -> None:
        """After `clear`: verify the devices anew and be ready again.

        Raises PartInGrip where the fault left a part in the grip, and latches that: `clear` it,
        `release` the part on purpose, and `reset` again. Other faults are raised as they are.
        """
        self._finish(self.start_command(Command.RESET), timeout_s)

    def follow_real_time(self, speed: float = 1.0, clock: "Clock" = time) -> None:
        """Have the time of a simulated cell follow a real clock, where people watch it.

        It begins between two jobs. Before it, and for tests, virtual time runs as fast as the
        machine goes, and stands still between two jobs. A real cell is left as it is.

        Parameters
        ----------
        speed
            Virtual seconds in a real one; 0: as before it.
        clock
            The real clock.
        """

        def begin() -> None:
            self._worker.idle_period_s = self._cell.follow(clock, speed)

        if not self._cell.realtime:
            self._worker.between_jobs(begin)

    def simulate(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Ask the simulated cell for something and return its reply, also while a job runs.

        As ``{"inject": "servo1.off"}`` and ``{"clear": "servo1.off"}``, which begin and end a
        fault, and ``{"place": "cylinder:diameter=8mm,length=20mm"}``, which exchanges the part.
        `simulator.realtime.requests` has all requests.

        Raises
        ------
        RequestRefused
            If the request cannot be carried out, or the cell has real ports.
        CellStateError
            If a part is exchanged that the fingers hold: release it first. If the cell has no time
            for it: ask again.
        """
        return self._simulated()(dict(request))

    def begin_simulation_reset(self) -> Job:
        """Start to make a simulated cell ready, whatever has happened, and return the job.

        All faults of the simulation end, a fault of the cell is cleared, the fingers open, and
        nothing lies between them. Raises RequestRefused if the cell has real ports, CellStateError
        while a job runs.
        """
        simulation, controller = self._simulated(), self._cell.controller

        def work(_report: Report) -> None:
            simulation.end_faults()
            if controller.state is CellState.ABORTED:
                controller.clear(reboot=True)
            if controller.state in (CellState.RESETTING, CellState.STOPPED):
                controller.release_held()
            else:
                controller.release()
            simulation.empty()
            if controller.state is CellState.RESETTING:
                controller.reset()
            if controller.state is CellState.STOPPED:
                controller.start()

        return self._accept(work, None, "simulation_reset")

    def _simulated(self) -> "SimulationRequests":
        if self._simulation is None:
            raise RequestRefused("this cell has real ports: nothing of it is simulated")
        return self._simulation

    def save(self, path: Path | str, *, followed: bool = False) -> None:
        """Write the taught model, and its training set as a data set beside it.

        With both files a plugin that loads the model can teach further objects. With ``followed``
        the model expects the drift that this session has followed: for the rest of a shift.

        Raises
        ------
        CellStateError
            If nothing was taught yet.
        ModelError, DatasetError
            If a file cannot be written.
        """
        self._model.save(path, followed=followed)

    def remark(self, kind: str, text: str) -> None:
        """Write into the recording that something happened, with the next job or its end."""
        if self._cell.records:
            self._remarks.append((kind, text))

    def train(self, timeout_s: float | None = None) -> None:
        """Train the model on all taught grasps, after jobs with ``TeachGoal.train`` off.

        Raises CellError if the grasps do not suffice; they are kept. ModelError or DatasetError if
        the model cannot be written.
        """
        file = self._file

        def work(_report: Report) -> None:
            file.model.train()
            file.due = True
            file.write()

        self._finish(self._accept(work, None, "train"), timeout_s)

    def forget_drift(self, timeout_s: float = 5.0) -> None:
        """Forget the followed drift, as after work on the sensors, and follow anew."""
        self._finish(self.start_forget_drift(), timeout_s)

    def start_forget_drift(self) -> Job:
        """Start `forget_drift` as a job and return its handle at once."""
        model = self._model
        return self._accept(lambda _report: model.forget_drift(), None, "forget_drift")

    def close(self, timeout_s: float = 30.0) -> None:
        """Stop what runs and disconnect; a held part stays held. A second call does nothing.

        Jobs that were accepted end as cancelled, unless they were nearly done; further ones are
        refused.

        Raises
        ------
        CellStateError
            If the mover calls this: a job cannot wait for its own end. Nothing changes.
        TimeoutError
            If the running job does not end in time, as while the mover has not returned. Jobs are
            refused from then on; call this again to disconnect.
        ModelError, DatasetError, RecordingError
            If what was taught cannot be written to ``save``, or something is lost of the recording.
            Everything else has ended.
        """
        self._worker.check_outside()
        with self._ending:
            if self._closed:
                return
            if self._lease is not None:
                self._lease.close()
            self._stop_jobs()
            self._worker.close(timeout_s)
            _write_remarks(self._cell.controller, self._remarks)
            self._closed = True
            try:
                self._cell.close()
            finally:
                if self._reading is not None:
                    self._reading.join()
                self._file.write()

    def __del__(self) -> None:
        if self._closed or sys.is_finalizing():
            return
        if self._lease is not None:
            self._lease.end_watch()
        self._stop_jobs()
        self._worker.end(self._cell.close)
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
        """Refuse further jobs, then stop those that were accepted: a later one would go on."""
        with self._starting:
            self._worker.refuse()
            self._cell.controller.cancel()

    def _finish(self, job: Job, timeout_s: float | None) -> Any:
        """Wait for a command and return what it does; its error is raised as it is."""
        with self._calling():
            status = self._worker.wait(job, timeout_s)
        if status.exception is not None:
            raise status.exception
        return status.value

    def _accept(self, work: Callable[[Report], Any], command: Command | None, task: str) -> Job:
        """Start a job that no earlier `cancel` is meant for, where its command is allowed now."""
        controller, remarks, file = self._cell.controller, self._remarks, self._file
        last_answer, number = self._last_answer, 0

        def accepted(job: Job) -> None:
            nonlocal number
            if command is not None:
                controller.check(command)
            controller.forget_cancel()
            if self._interrupted:
                controller.cancel()
            number = job.number
            if task in _NAMING:
                last_answer.clear()

        def recorded(report: Report) -> Any:
            _write_remarks(controller, remarks)
            end = "succeeded"
            try:
                value = work(report)
                if isinstance(value, Answer):
                    value = replace(value, job=number)
                    last_answer.append(value)
                return value
            except BaseException as error:
                end = f"failed: {error_text(error)}"
                raise
            finally:
                _write_remarks(controller, remarks)
                controller.remark("job", f"{task} {end}")
                if not controller.status.holding:  # nothing to look after meanwhile
                    with suppress(CellError):  # `close` is the last to try, and raises it
                        file.write()

        with self._calling(), self._starting:
            return self._worker.start(recorded, accepted=accepted)

    def _calling(self) -> AbstractContextManager[None]:
        return nullcontext() if self._lease is None else self._lease.calling("the host")


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


def _write_remarks(controller: "CellController", remarks: deque[tuple[str, str]]) -> None:
    """Write remarks of other threads: the recording belongs to the thread of the cell."""
    while remarks:
        controller.remark(*remarks.popleft())
