"""`recordings list`, `recordings mark`, `recordings unmark`: recordings that a cell keeps."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Recordings that are kept: list, mark, unmark.")

RecordingsArgument = Annotated[list[Path], typer.Argument(help="Recordings (.mcap).")]


@app.command("list")
def list_recordings(
    folder: Annotated[
        Path, typer.Argument(help="Folder of all jobs: recording.directory, or that of --out.")
    ] = Path("out"),
) -> None:
    """List the recordings of all jobs in a folder, oldest first."""
    from datetime import datetime

    from rich.table import Table

    from cell.data.retention import recordings
    from cell.interfaces.cli.terminal import plain_text, print_table

    table = Table("recording", "MB", "last write", "marked")
    for one in recordings(folder):
        size, written = f"{one.n_bytes / 1e6:.1f}", datetime.fromtimestamp(one.written_s)
        marked = "yes" if one.marked else ""
        table.add_row(plain_text(str(one.path)), size, f"{written:%Y-%m-%d %H:%M}", marked)
    print_table(table)


@app.command()
def mark(recordings: RecordingsArgument) -> None:
    """Mark recordings, so that they are never deleted."""
    from cell.data.retention import mark as mark_one
    from cell.interfaces.cli.terminal import print_line

    for path in recordings:
        mark_one(path)
        print_line(f"{path}: marked")


@app.command()
def unmark(recordings: RecordingsArgument) -> None:
    """Remove the mark of recordings."""
    from cell.data.retention import unmark as unmark_one
    from cell.interfaces.cli.terminal import print_line

    for path in recordings:
        unmark_one(path)
        print_line(f"{path}: not marked")
