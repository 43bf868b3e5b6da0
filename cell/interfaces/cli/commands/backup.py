"""`service backup` and `service restore`: all files of a cell in one file."""

from pathlib import Path
from typing import Annotated

import typer

from cell.commissioning.cell_backup import back_up, restore as unpack
from cell.interfaces.cli.options import FOLDER_CONFIG, ConfigOption
from cell.interfaces.cli.terminal import print_line


def backup(
    file: Annotated[Path, typer.Argument(help="Backup to write (.tar).")],
    config: ConfigOption = None,
    model: Annotated[
        list[Path] | None,
        typer.Option("--model", "-m", help="Model in another folder; repeat for several."),
    ] = None,
) -> None:
    """Write config, self-zero, models, data sets, photos, findings and record to one file.

    It takes the files in the folder of the config, and those that the config names. Recordings,
    history, tokens, secrets and certificates are left out.
    """
    n_files = back_up(file, config or FOLDER_CONFIG, model or ())
    print_line(f"{file}: {n_files} files, {file.stat().st_size / 1e6:.1f} MB")


def restore(
    file: Annotated[Path, typer.Argument(help="Backup to restore.")],
    folder: Annotated[Path, typer.Argument(help="New folder for the cell.")],
) -> None:
    """Unpack a backup into a new folder; nothing is written to a device."""
    print_line(f"{folder}: {unpack(file, folder)} files of {file}")
