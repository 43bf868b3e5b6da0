"""The cell of a command: its config, its start, and the message when it ends early."""

import shlex
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from shutil import rmtree
from typing import Any

from rich.table import Table

from cell.build import Cell, build_cell
from cell.config.file import load_config
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.journal import loop_line
from cell.control.lifecycle import NO_GRIP
from cell.control.records import pad_array
from cell.errors import (
    CellError,
    CellStopped,
    ConfigError,
    HandLost,
    PartInGrip,
    PositionerFault,
    RecordingError,
)
from cell.fault_catalogue import EXPECTED_ERRORS, fault_number
from cell.interfaces.cli.signals import NOTHING_LET_GO, stopping
from cell.interfaces.cli.terminal import (
    ask,
    print_cell,
    print_line,
    print_note,
    progress_bar,
    show,
    write_json,
)
from cell.learning.model import LAST_MODEL
from cell.learning.parallel import Progress
from cell.runtime.goals import Goal
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import Job
from gripper.errors import (
    FeedbackImplausible,
    LinkTooSlow,
    ServoFault,
    ServoMissing,
    VerificationFailed,
    fingers_left,
)
from recognition.grasp import PadArray


def cell_config(
    file: Path | None,
    *,
    seed: int | None = None,
    faults: Sequence[str] | None = None,
    simulate: bool = False,
) -> CellConfig:
    """Return the config of the cell of a command, and print which cell it is.

    Raises ConfigError as `load_config`, or if faults are given for real ports.

    Parameters
    ----------
    file
        Its config file; None for the built-in simulated cell.
    seed, faults
        Another seed, and faults of the simulated cell in addition to those of the config.
    simulate
        Whether to simulate the cell even if the config names real ports.
    """
    config = load_config(file)
    if file is None:
        print_cell("the built-in simulated cell; --config FILE names another")
    elif config.simulated or simulate:
        print_cell(f"{config.name}, simulated ({file})")
    else:
        ports = f"{config.gripper.port}, {config.tactile.place}"
        print_cell(f"{config.name} at {ports} ({file})")
    if seed is not None:
        config = config.model_copy(update={"seed": seed})
    return with_faults(config, faults, simulate=simulate)


def with_faults(
    config: CellConfig, faults: Sequence[str] | None, *, simulate: bool = False
) -> CellConfig:
    """Return a config with further faults of its simulated cell, as `cell_config`.

    The daily self-zero at the start is left out, so that it does not meet these faults.
    """
    if not faults:
        return config
    if not (config.simulated or simulate):
        raise ConfigError(
            f"--fault {faults[0]} is for the simulated cell, but {config.name} has real "
            "ports: use it with `tactile-cell simulate`, or leave it out"
        )
    added = {"faults": (*config.simulator.faults, *faults)}
    changes: dict[str, Any] = {"simulator": config.simulator.model_copy(update=added)}
    if config.self_zero == "daily" and not simulate:
        changes["self_zero"] = "on_demand"
    return config.model_copy(update=changes)


def model_of_folder(given: Path | None) -> Path | None:
    """Return the given model, else that of the last `model train` in this folder, and print it."""
    if given is not None or not (last := Path(LAST_MODEL)).is_file():
        return given
    model = Path(last.read_text("utf-8", "replace").strip()).name
    if not Path(model).is_file():
        return None
    print_note(f"the model is {model} of the last `model train` here; --model FILE names another")
    return Path(model)


def pads_of(config: CellConfig) -> PadArray:
    """Return the geometry of the configured pads."""
    return pad_array(layout_from_config(config.tactile))


def release_command(config_file: Path) -> str:
    """Return the command that lets go of a part in the cell of that config file."""
    return f"tactile-cell hand release --config {shlex.quote(str(config_file))} --confirm"


def clear_command(config_file: Path) -> str:
    """Return the command that restarts the servos with faults in the cell of that config file."""
    return f"tactile-cell hand clear --config {shlex.quote(str(config_file))} --reboot"


@contextmanager
def cell_of_earlier_run(config: CellConfig) -> Iterator[Cell]:
    """Build a cell without starting it; a line may be missing, and no object is moved."""
    cell = build_cell(config, mover=lambda _pose: False, ask=ask, partial=True)
    for text in cell.controller.hand.missing:
        print_note(f"{text}; steps that need it are left out")
    try:
        with stopping(cell.controller.life.interrupt):
            yield cell
    finally:
        cell.close()


@dataclass(frozen=True, slots=True)
class RunningCell:
    """The started cell of a command."""

    plugin: TactileCellPlugin
    folder: Path
    """Folder of the command, for recording and reports."""
    progress: Progress
    """Draws a bar for each task."""
    json_file: Path | None
    """File for the JSON of the command."""

    def run(self, goal: Goal, on_progress: Callable[[Job], None] = lambda _job: None) -> Any:
        """Run a job, show its bar, return its result. Raises as `TactileCellPlugin.run`."""

        def show(job: Job) -> None:
            on_progress(job)
            now = job.progress
            if done := now.get("parts", now.get("grasps", 0) + now.get("missed", 0)):
                task = " ".join(filter(None, (now["task"], now.get("label"))))
                self.progress(task, done, now["of"])

        return self.plugin.run(goal, on_progress=show)

    def finish(self, lines: Iterable[str | Table], values: Mapping[str, Any]) -> None:
        """Show the result of the command, its JSON with the recording and the health of the loop.

        Raises RecordingError if the recording has stopped: the job has its answer all the same.
        """
        made = {"recording": self.plugin.recording_path, "health": self.plugin.cell.health()}
        show(lines, {**values, **made}, self.json_file)
        self.plugin.cell.check_recording()


@contextmanager
def running_cell(
    config: CellConfig,
    job: str,
    out_folder: Path | None,
    *,
    config_file: Path | None,
    json_file: Path | None,
    **cell: Any,
) -> Iterator[RunningCell]:
    """Start a cell, stop it on signals, close it at the end.

    At the end it prints the timing of the force loop. A run that ends early raises CellError. Its
    text names the state of the grip, the recording and, on real ports, the command that lets go.
    ``json_file`` gets the same text, and the health of loop and links. If only the recording
    failed, the job still has an answer: the caller shows it, then calls
    `RunningCell.finish`.

    Parameters
    ----------
    config
        The cell.
    job, out_folder
        Name of the job's new folder for recording and reports, and its parent folder; None: the
        folder of the config.
    config_file
        The file that ``config`` was read from.
    json_file
        File for the reason of an early end, as JSON.
    cell
        Model and further arguments of `TactileCellPlugin`.

    Raises
    ------
    CellError
        If the run ends early, or the folder cannot be created.
    """
    folder = job_folder(out_folder or Path(config.recording.directory), job)
    if json_file is not None:
        with suppress(OSError):  # the answer of an earlier run
            json_file.unlink(missing_ok=True)
    with removed_if_unused(folder):
        plugin = TactileCellPlugin(
            config, folder=folder, ask=ask, note=print_note, start=False, **cell
        )
    done = False
    try:
        with stopping(plugin.interrupt, left=NOTHING_LET_GO), _closing(plugin):
            for note in (before := _notes(plugin)):
                print_note(note)
            with progress_bar() as progress:
                plugin.reset(timeout_s=None)
                for note in _notes(plugin):
                    if note not in before:
                        print_note(note)
                yield RunningCell(plugin, folder, progress, json_file)
            done = True
    except (*EXPECTED_ERRORS, OSError) as error:
        if done and isinstance(error, RecordingError) and error.__context__ is None:
            return
        recording = plugin.recording_path
        if isinstance(error, CellStopped):
            text = f"{error}. Recording so far: {recording}"
        else:
            text = f"{error}\n{_grip_left(plugin, error)}; recording so far: {recording}"
        if config_file is not None and not config.simulated:
            limp = isinstance(error, FeedbackImplausible | VerificationFailed) and not isinstance(
                error, ServoMissing
            )
            if not limp and NO_GRIP[True] not in text:
                text += f"\nto let go of a part: {release_command(config_file)}"
            if isinstance(error, ServoFault) and error.bits:
                text += f"\nto clear the servo's error: {clear_command(config_file)}"
            if isinstance(error, PositionerFault):
                text += f"\nto clear the fault of the axis: {clear_command(config_file)}"
        write_json(
            json_file,
            {
                "ended_early": text,
                "fault_number": fault_number(error),
                "recording": recording,
                "health": plugin.cell.health(),
                "progress": plugin.job().progress,
            },
        )
        raise CellError(text) from error


def job_folder(directory: Path, job: str) -> Path:
    """Make a new folder for one job, named by job and time; never use an existing one.

    Raises CellError if it cannot be made.
    """
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    for attempt in range(100):
        folder = directory / (f"{job}-{stamp}" if attempt == 0 else f"{job}-{stamp}-{attempt}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise CellError(
                f"{folder} cannot be made: {error}; name another folder with --out"
            ) from error
        return folder
    raise CellError(f"{directory} has 100 folders of {job}-{stamp}; name another folder with --out")


@contextmanager
def removed_if_unused(folder: Path | None) -> Iterator[None]:
    """Remove a job's folder, and an empty recording, if the job does not start."""
    try:
        yield
    except BaseException:
        if folder is not None:
            rmtree(folder, ignore_errors=True)
        raise


@contextmanager
def _closing(plugin: TactileCellPlugin) -> Iterator[None]:
    """Close the cell at the end, also after Ctrl-C; print the timing of its loop."""
    try:
        try:
            yield
        except BaseException:
            # The first error ends the command; a note names a recording that has stopped.
            with suppress(RecordingError):
                plugin.close()
            raise
        plugin.close()
    finally:
        if plugin.cell.realtime:
            hand = plugin.cell.controller.hand
            print_line(loop_line(hand.statistics.loop, hand.period_s))


def _notes(plugin: TactileCellPlugin) -> list[str]:
    """Return the state of the force loop, and why there is no self-zero."""
    controller = plugin.cell.controller
    return [*filter(None, (*controller.hand.notes, controller.zeroing.note))]


def _grip_left(plugin: TactileCellPlugin, error: BaseException) -> str:
    """Return the grip after an error as text, as far as it is known."""
    life = plugin.cell.controller.life
    if left := fingers_left(error):
        return left
    if isinstance(error, HandLost):
        return "a part may still be gripped" if life.holding else NO_GRIP[False]
    if isinstance(error, PartInGrip | VerificationFailed | LinkTooSlow):
        return "nothing was moved"
    return "the grip is kept" if life.holding else NO_GRIP[life.shows_nothing]
