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
        bool, typer.Option("--confirm", help="Confirm that the part may fall; required.")
    ] = False,
) -> None:
    """Let go of a part in the grip of an earlier run; it may fall.

    Only the servos are needed, not the control unit. If the servo of a finger is silent or off, a
    message names that finger and the other finger opens. Always name the config file, even if the
    folder has one: so the part falls in the intended cell.
    """
    from cell.errors import ConfigError
    from cell.interfaces.cli.options import FOLDER_CONFIG
    from cell.interfaces.cli.session import cell_config, cell_of_earlier_run, release_command

    if config is None:
        example = FOLDER_CONFIG if FOLDER_CONFIG.exists() else Path("FILE")
        raise ConfigError(
            "the config file of the cell is missing; nothing was moved. The whole command: "
            f"`{release_command(example)}`"
        )
    if not confirm:
        raise ConfigError(
            "the part may fall, so --confirm is required; nothing was moved. The whole command: "
            f"`{release_command(config)}`"
        )
    from cell.interfaces.cli.terminal import print_line

    checked = cell_config(config)
    with cell_of_earlier_run(checked) as cell:
        report = cell.controller.release_held()
    print_line(
        f"{checked.name}: released; {report}"
        + ("; the cell is simulated, no real part was moved" if checked.simulated else "")
    )
