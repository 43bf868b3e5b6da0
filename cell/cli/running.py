"""What the commands that move a cell share: its start, and the grip that outlasts an early end."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from cell.build import Cell, build_cell
from cell.cli.asking import ask
from cell.cli.output import say, warn, write_json
from cell.cli.stopping import END_WITHIN_S, stopping
from cell.collect import pad_array
from cell.config import CellConfig
from cell.errors import CellError, CellStopped, ConfigError
from cell.layouts import layout_from_config
from cell.loop_values import loop_line
from gripper.errors import GripperError, fingers_left
from recognition.grasp import PadArray
from tactile.errors import TactileError


@contextmanager
def running_cell(
    config: CellConfig, folder: Path, capture: Path | None = None, *, json_file: Path | None = None
) -> Iterator[Cell]:
    """Start a cell, stop it on signals, and say what is kept where if it ends early.

    How punctual the force loop was is said in each case; a run that ends early writes why, and the
    health of loop and links, to ``json_file``.
    """
    cell = build_cell(config, folder=folder, ask=ask, capture=capture)
    for note in cell.notes:
        warn(note)
    try:
        with stopping(cell.controller.cancel, end_within_s=END_WITHIN_S), _closing(cell):
            cell.controller.start()
            yield cell
    except CellStopped as stop:
        text = f"{stop}. Recording so far: {cell.recording_path}"
        _write_end(json_file, cell, text)
        raise CellError(text) from stop
    except (CellError, GripperError, TactileError, OSError) as error:
        grip = fingers_left(error) or (
            "the grip is kept" if cell.controller.holding else "nothing is held"
        )
        text = f"{error}\n{grip}; recording so far: {cell.recording_path}"
        _write_end(json_file, cell, text)
        raise CellError(text) from error


@contextmanager
def _closing(cell: Cell) -> Iterator[None]:
    """Close the cell at the end, and say how its loop did: after Ctrl-C, too."""
    try:
        yield
    finally:
        try:
            cell.close()
        finally:
            if cell.realtime:
                hand = cell.controller.hand
                say(loop_line(hand.statistics.loop, hand.period_s))


def _write_end(json_file: Path | None, cell: Cell, text: str) -> None:
    write_json(
        json_file,
        {
            "ended_early": text,
            "recording": None if cell.recording_path is None else str(cell.recording_path),
            "health": cell.health(),
        },
    )


def seeded(config: CellConfig, seed: int | None) -> CellConfig:
    """Return the config with another seed, where one is given."""
    return config if seed is None else config.model_copy(update={"seed": seed})


def faulted(config: CellConfig, faults: Sequence[str] | None) -> CellConfig:
    """Return the config with faults of the simulated cell added to its own.

    Raises
    ------
    ConfigError
        If the config has real ports: nothing is injected into real hardware.
    """
    if not faults:
        return config
    if not config.simulated:
        raise ConfigError(
            f"--fault {faults[0]} is for the simulated cell, and {config.name} has real ports: "
            "give it to `tactile-cell simulate`, or leave it out"
        )
    simulator = config.simulator.model_copy(update={"faults": (*config.simulator.faults, *faults)})
    return config.model_copy(update={"simulator": simulator})


def pads_of(config: CellConfig) -> PadArray:
    """Return where the taxels of the configured pads are."""
    return pad_array(layout_from_config(config.tactile))
