"""`simulate`: runs the simulated cell as a separate process for other programs."""

import json
import time
from pathlib import Path
from typing import Annotated

import typer

from cell.control.positioner import SocketPlacer
from cell.errors import CellError, ConfigError
from cell.interfaces.cli import options
from cell.interfaces.cli.session import cell_config
from cell.interfaces.cli.terminal import ask, print_error, print_line
from cell.runtime.simulate import serve_simulated_cell
from simulator.errors import SimulatorError
from simulator.faults.vocabulary import VOCABULARY
from simulator.realtime.hands import Hands


def simulate(
    config: options.Config = None,
    folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of device links and config [default: a new one]."),
    ] = None,
    seed: options.Seed = None,
    faults: options.Faults = None,
    list_faults: Annotated[
        bool, typer.Option("--list-faults", help="Print all faults (NAME=VALUE@TIME), and end.")
    ] = False,
    ask: Annotated[
        str | None,
        typer.Option(
            "--ask",
            metavar="WORDS",
            help="Act as the operator's hands on the cell in --out, then end. 'help' lists the "
            "actions; '-' reads them line by line.",
        ),
    ] = None,
    with_parent: Annotated[
        bool, typer.Option("--with-parent", help="End when the parent program ends.", hidden=True)
    ] = False,
) -> None:
    """Run the simulated cell for other programs, until Ctrl-C or SIGTERM.

    When programs can connect, it prints one JSON line with its device paths.
    """
    if ask is not None:
        _be_hands(folder or Path(), ask)
        return
    if list_faults:
        for fault in VOCABULARY.values():
            moment = " (a moment, without end)" if fault.moment else ""
            value = f" [{fault.value.text}]" if fault.value else ""
            print_line(f"{fault.name:<22} {fault.meaning}{moment}{value}")
        return
    serve_simulated_cell(
        cell_config(config, seed=seed, faults=faults, simulate=True),
        folder=folder,
        announce=lambda line: typer.echo(json.dumps(line)),
        until_parent_ends=with_parent,
    )


def _be_hands(folder: Path, text: str) -> None:
    """Send a request to the simulated cell that runs in a folder; print the reply."""
    hands = Hands(SocketPlacer(str(folder / "positioner.sock")).ask, time.sleep)
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
