"""`simulate`: runs the simulated cell as a process of its own, for other programs."""

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import ConfigOption, FaultOption, SeedOption


def simulate(
    frames: Annotated[
        Path | None, typer.Option("--frames", help="Play the grasps of this data set or recording.")
    ] = None,
    config: ConfigOption = None,
    folder: Annotated[
        Path | None, typer.Option("--out", help="Folder for device links and the ready config.")
    ] = None,
    seed: SeedOption = None,
    faults: FaultOption = None,
    list_faults: Annotated[
        bool, typer.Option("--list-faults", help="Print every fault that there is, and end.")
    ] = False,
    ask: Annotated[
        str | None,
        typer.Option(
            "--ask",
            metavar="WORDS",
            help="Be the hands at the cell that runs in --out, and end: look, close, open, half, "
            "block, part, press, load, lift, empty, disconnect, connect, as 'open finger 0', "
            "'block 10', 'press finger0.inner tip left'; 'help' explains them. '-' asks for them "
            """line by line. Programs send JSON, as '{"state": true}': place, define, remove, """
            "press, lift, play, hand, state, kinds, inject, clear.",
        ),
    ] = None,
    with_parent: Annotated[
        bool, typer.Option("--with-parent", help="End with the program that started this one.")
    ] = False,
) -> None:
    """Run the simulated cell for other programs, until SIGTERM.

    Prints one JSON line with its device paths when they can connect.
    """
    from cell.interfaces.cli.session import cell_config
    from cell.interfaces.cli.terminal import print_line
    from cell.jobs.simulate import serve_simulated_cell
    from cell.simulation import fault_table

    if ask is not None:
        _be_hands(folder or Path(), ask)
        return
    if list_faults:
        for name, kind, value, meaning in fault_table():
            print_line(f"{name:<22} {kind:<13} {meaning}" + (f" [{value}]" if value else ""))
        return
    serve_simulated_cell(
        cell_config(config, seed=seed, faults=faults, simulate=True),
        frames=frames,
        folder=folder,
        announce=lambda line: typer.echo(json.dumps(line)),
        until_parent_ends=with_parent,
    )


def _be_hands(folder: Path, text: str) -> None:
    """Do what a text says at the simulated cell whose devices are in a folder; print the reply."""
    from contextlib import closing

    from cell.control.positioner import SocketPlacer
    from cell.errors import CellError, ConfigError
    from cell.interfaces.cli.terminal import ask, print_error, print_line
    from simulator.errors import SimulatorError
    from simulator.realtime.hands import Hands

    with closing(SocketPlacer(str(folder / "positioner.sock"))) as cell:
        hands = Hands(cell.ask, time.sleep)
        if text.startswith("{"):
            try:
                request = json.loads(text)
            except ValueError as error:
                raise ConfigError(f"--ask {text!r:.80} is no JSON: {error}") from error
            typer.echo(json.dumps(cell.ask(request)))
            return
        try:
            while text == "-":
                try:
                    print_line(hands.do(ask("hands> ")))
                except (CellError, SimulatorError) as error:
                    print_error(str(error))
            print_line(hands.do(text))
        except EOFError:
            return
        except SimulatorError as error:
            raise ConfigError(str(error)) from error
