"""What a host program loads: a cell behind jobs that never block.

Found through the entry point ``tactile_cell`` of the group ``robot_cell.plugins``. The host moves;
the plugin grasps and tells what it held.
"""

import threading
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cell.build import Cell, build_cell
from cell.collect import pad_array
from cell.config import CellConfig
from cell.config_file import load_config
from cell.errors import CellStateError
from cell.goals import IdentifyGoal, TeachGoal, checked_goal
from cell.host_watch import HostWatch
from cell.layouts import layout_from_config
from cell.model import load_model, save_model
from cell.pad_knowledge import pad_knowledge
from cell.pose import Pose
from cell.shapes import FeltShape
from cell.states import CellState
from cell.status import CellStatus
from cell.taught import Answer, TaughtObjects
from cell.worker import CellWorker, Job, JobOutcome, JobStatus, Report

__all__ = ["Answer", "CellStatus", "FeltShape", "IdentifyGoal", "TactileCellPlugin", "TeachGoal"]


class TactileCellPlugin:
    """A cell for host programs without ROS.

    Calls return at once, but for `result`, `release` and `close`, which wait as long as they are
    told. A fault or a cancelled job keeps the grip; `release` is the only way to let go.

    With ``host_timeout_s`` in the config a host that makes no call for so long while a job runs
    has the job stopped, with the grip kept. Any call counts, `alive` too; a job keeps its result.
    """

    def __init__(
        self,
        config: Path | str | CellConfig | None = None,
        *,
        mover: Callable[[Pose], Pose | bool | None] | None = None,
        model: Path | str | None = None,
        gauge: Path | str | None = None,
        gauge_shape: str | None = None,
    ) -> None:
        """Connect to the cell, verify the devices and take the zero of the taxels.

        Parameters
        ----------
        config
            Config file or value; None is the built-in simulated cell.
        mover
            Called with each pose that the sequence wants the object at; returns None or True when
            it is reached, False to refuse, or the pose reached instead.
        model
            File of a taught model (`save`); without one, teach first.
        gauge
            Data set of grasps of one known object on this cell: shape and size are then read under
            the foam that it shows.
        gauge_shape
            Its shape, as ``sphere:diameter=9.5mm``; without it that of the configured object of
            the grasps' label.

        Raises
        ------
        ConfigError, ModelError, CellError
            Before any hardware is touched.
        gripper.errors.GripperError, tactile.errors.TactileError
            If a device is missing or not what the config says.
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
        self._config = checked
        self._starting = threading.Lock()
        self._taught = TaughtObjects(
            checked,
            None
            if model is None
            else load_model(Path(model), pad_array(layout_from_config(checked.tactile))),
            pad_knowledge(checked, None if gauge is None else Path(gauge), gauge_shape),
        )
        self._cell: Cell = build_cell(checked, mover=mover)
        try:
            self._cell.controller.start()
        except BaseException:
            self._cell.close()
            raise
        self._worker = CellWorker(
            idle=self._cell.controller.tick,
            idle_period_s=1.0 / checked.gripper.loop_rate_hz if self._cell.realtime else None,
        )
        self._watch: HostWatch | None = None
        if checked.host_timeout_s is not None:
            self._watch = HostWatch(
                checked.host_timeout_s,
                running=lambda: self._worker.running,
                silent=lambda silent_s: self._cell.controller.cancel(
                    f"because the host was silent for {silent_s:.2f} s"
                ),
            )

    # -- what a host asks ----------------------------------------------------------------------

    def info(self) -> dict[str, Any]:
        """Return name, layout and taught labels."""
        return {
            "name": self._config.name,
            "simulated": self._config.simulated,
            "n_taxels": self._cell.controller.pads.n_taxels,
            "labels": self.labels,
        }

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return self._taught.labels

    def state(self) -> str:
        """Return the state of the cell, a PackML name."""
        with self._calling():
            return self._cell.controller.state.value

    def status(self) -> CellStatus:
        """Return the states of cell and grip, with their numbers."""
        with self._calling():
            return CellStatus.of(self._cell.controller)

    def fault(self) -> str | None:
        """Return what is wrong, while a fault is latched."""
        with self._calling():
            return self._cell.controller.fault

    def alive(self) -> None:
        """Say that the host is there, and nothing else; see ``host_timeout_s``."""
        with self._calling():
            return

    def start(self, goal: TeachGoal | IdentifyGoal | Mapping[str, Any]) -> Job:
        """Start a job and return its handle at once.

        A goal is a `TeachGoal`, an `IdentifyGoal`, or a mapping with ``task`` ``teach`` or
        ``identify`` and the fields of these.

        Raises
        ------
        ConfigError
            If the goal has unknown fields or values out of range.
        CellStateError
            If another job runs, nothing was taught yet, or a model was loaded whose grasps are not
            at hand: teaching would forget its objects.
        """
        checked = checked_goal(goal)
        controller, shift = self._cell.controller, self._taught.shift
        if isinstance(checked, TeachGoal):
            if self._taught.loaded:
                raise CellStateError(
                    f"the loaded model knows {', '.join(self.labels)}, but their grasps are not in "
                    "it; teaching here would forget them: load the plugin without a model, or "
                    "extend the data set and train anew"
                )
            return self._accept(lambda report: self._taught.teach(controller, checked, report))
        if shift is None:
            raise CellStateError("nothing was taught; start a teach goal or load a model first")
        return self._accept(
            lambda report: self._taught.identify(controller, checked, shift, report)
        )

    def feedback(self, job: Job) -> JobStatus:
        """Say where a job stands; never waits."""
        with self._calling():
            return self._worker.status(job)

    def result(self, job: Job, timeout_s: float) -> Any:
        """Wait for a job and return its `Answer`, or the number of grasps taught.

        Raises
        ------
        TimeoutError
            If it is not over in time; it goes on.
        CellStateError
            If it was cancelled or aborted, with the reason.
        """
        with self._calling():
            status = self._worker.wait(job, timeout_s)
        if status.outcome is not JobOutcome.SUCCEEDED:
            raise CellStateError(f"job {job.number} {status.outcome.value}: {status.error}")
        return status.value

    def cancel(self, job: Job) -> None:
        """Stop a job; what is held stays held. Does nothing to a job that is over."""
        with self._starting:
            if not self.feedback(job).outcome.terminal:
                self._cell.controller.cancel()

    def release(self, timeout_s: float = 30.0) -> None:
        """Let the part go and open the fingers; the only way to do so outside a sequence.

        After a fault: `clear`, then `release`, then `reset`.
        """
        controller = self._cell.controller

        def work(_report: Report) -> None:
            if controller.state in (CellState.RESETTING, CellState.STOPPED):
                controller.release_held()
            else:
                controller.release()

        self.result(self._accept(work), timeout_s)

    def clear(self, timeout_s: float = 5.0, *, reboot: bool = False) -> None:
        """Acknowledge a latched fault; the grip stays as it is.

        With ``reboot`` servos that report a hardware error are restarted: what one of them still
        held would drop.
        """
        controller = self._cell.controller
        self.result(self._accept(lambda _report: controller.clear(reboot=reboot)), timeout_s)

    def reset(self, timeout_s: float = 60.0) -> None:
        """After `clear`: verify the devices anew and be ready again.

        A part that the fault left in the grip is released first, on purpose: `release`.
        """
        controller = self._cell.controller

        def work(_report: Report) -> None:
            if controller.state is not CellState.STOPPED:
                controller.reset()
            controller.start()

        self.result(self._accept(work), timeout_s)

    def save(self, path: Path | str, *, followed: bool = False) -> None:
        """Write what was taught to a model file, as it was taught.

        With ``followed`` the model expects the drift that this session has followed: for the rest
        of a shift. Raises CellStateError if nothing was taught.
        """
        shift = self._taught.shift
        if shift is None:
            raise CellStateError("nothing was taught, there is no model to save")
        save_model(
            Path(path),
            shift.recognizer if followed else shift.taught,
            trainer_name=self._config.recognition.recognizer,
            pads=self._cell.controller.pads,
            sections=self._taught.sections,
        )

    def forget_drift(self, timeout_s: float = 5.0) -> None:
        """Forget the followed drift, as after work on the sensors, and follow anew."""

        def work(_report: Report) -> None:
            if self._taught.shift is not None:
                self._taught.shift.forget()

        self.result(self._accept(work), timeout_s)

    def close(self, timeout_s: float = 30.0) -> None:
        """Stop what runs and disconnect; a held part stays held."""
        if self._watch is not None:
            self._watch.close()
        self._cell.controller.cancel()
        self._worker.close(timeout_s)
        self._cell.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _accept(self, work: Callable[[Report], Any]) -> Job:
        """Start a job that no earlier `cancel` is meant for."""
        with self._calling(), self._starting:
            return self._worker.start(work, accepted=self._cell.controller.forget_cancel)

    def _calling(self) -> AbstractContextManager[None]:
        return nullcontext() if self._watch is None else self._watch.calling()
