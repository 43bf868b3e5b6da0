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
    from cell.interfaces.cli.session import cell_config, cell_of_earlier_run, release_command

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
    from cell.interfaces.cli.terminal import print_line

    checked = cell_config(config)
    with cell_of_earlier_run(checked) as cell:
        report = cell.controller.release_held()
    print_line(
        f"{checked.name}: released; {report}"
        + ("; it is simulated, nothing real was moved" if checked.simulated else "")
    )
