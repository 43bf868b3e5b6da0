"""`service support`: packs files for remote support."""

from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import ConfigOption
from cell.interfaces.cli.session import cell_config
from cell.interfaces.cli.support_bundle import write_bundle
from cell.interfaces.cli.terminal import print_line

_MB = 1_000_000
"""Bytes in a megabyte."""


def support(
    file: Annotated[Path, typer.Argument(help="Bundle to write (.zip).")],
    config: ConfigOption = None,
    recordings: Annotated[
        Path | None,
        typer.Option("--recordings", help="Folder of recordings [default: recording.directory]."),
    ] = None,
    limit_mb: Annotated[
        float,
        typer.Option("--limit-mb", min=0.0, help="Largest recording that is packed, in MB."),
    ] = 50.0,
) -> None:
    """Pack config, versions, last faults, health, journal and the last recording for support.

    Tokens and secrets are removed. The service may run meanwhile. Check the bundle before you send
    it: it contains names of objects and machines.
    """
    cell = cell_config(config)
    folder = recordings or Path(cell.recording.directory)
    for member in write_bundle(file, cell, folder, round(limit_mb * _MB)):
        print_line(f"  {member.name}: {member.note}")
    print_line(f"wrote {file}")
