"""`simulate`: runs the simulated cell as a process of its own, for other programs."""

import json
from pathlib import Path
from typing import Annotated, Any

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
            metavar="JSON",
            help="Ask the cell that runs in --out, and end: "
            """'{"place": "ball"}', '{"hand": {"1": 0.02, "2": 0}}' moves limp fingers to half """
            """openings in m, '{"press": 0, "x_m": 0.01, "force_n": 2}' presses pad 0 with a """
            """fingertip, '{"lift": true}' lifts it, 'state', 'remove', 'inject', 'clear' as in """
            "the docs.",
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
        typer.echo(json.dumps(_asked(folder or Path(), ask)))
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


def _asked(folder: Path, text: str) -> dict[str, Any]:
    """Send one request to the simulated cell whose devices are in a folder; return the reply."""
    from contextlib import closing

    from cell.control.positioner import SocketPlacer
    from cell.errors import ConfigError

    try:
        request = json.loads(text)
    except ValueError as error:
        raise ConfigError(f"--ask {text!r:.80} is no JSON: {error}") from error
    if not isinstance(request, dict):
        raise ConfigError("--ask takes a JSON object, as '{\"state\": true}'")
    with closing(SocketPlacer(str(folder / "positioner.sock"))) as client:
        return client.ask(request)
