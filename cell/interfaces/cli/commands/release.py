"""`release`: lets go of a part that an earlier run left in the grip."""

from pathlib import Path
from typing import Annotated

import typer

NamedConfigOption = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="Config file of the cell that holds the part; required."),
]


def release(
    config: NamedConfigOption = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="The part may fall, and that is meant; required.")
    ] = False,
) -> None:
    """Let go of a part in the grip of an earlier run; it may fall.

    The servos alone are needed for it, not the control unit. A finger whose servo is silent or has
    switched itself off is left as it is and named; the other one opens. The cell has to be named,
    even where a config file lies in the folder: the part falls in the cell that is named and in no
    other.
    """
    from cell.errors import ConfigError
    from cell.interfaces.cli.options import FOLDER_CONFIG
    from cell.interfaces.cli.session import cell_config, missing_lines, release_command

    if config is None:
        example = FOLDER_CONFIG if FOLDER_CONFIG.exists() else Path("FILE")
        raise ConfigError(
            "name the cell that holds the part; nothing was moved. The whole command: "
            f"`{release_command(example)}`"
        )
    if not confirm:
        raise ConfigError(
            f"the part may fall; nothing was moved. If that is meant: `{release_command(config)}`"
        )
    from cell.build import build_cell
    from cell.interfaces.cli.signals import END_WITHIN_S, stopping
    from cell.interfaces.cli.terminal import ask, print_line

    checked = cell_config(config)
    cell = build_cell(checked, mover=lambda _pose: False, ask=ask, partial=True)
    missing_lines(cell)
    try:
        with stopping(cell.controller.cancel, end_within_s=END_WITHIN_S):
            report = cell.controller.release_held()
    finally:
        cell.close()
    print_line(
        f"{checked.name}: released; {report}"
        + ("; it is simulated, nothing real was moved" if checked.simulated else "")
    )
