"""`recording`: lists, marks, reports on, plots and recovers recordings."""

from datetime import datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from cell.archive.selection import cell_of, day_of, is_archive, parse_selection
from cell.errors import CellError
from cell.installation import extra
from cell.interfaces.cli import options
from cell.interfaces.cli.terminal import plain_text, print_line, print_note, print_table, show
from cell.recording.dataset import read_grasps
from cell.recording.reader import read_recording, recover_recording
from cell.recording.retention import mark as mark_one, recordings
from cell.report.page import grasp_figure, write_picture, write_report
from cell.report.recorded import recorded_report


def list_recordings(
    folder: Annotated[
        Path, typer.Argument(help="Folder of all jobs: recording.directory, or that of --out.")
    ] = Path("out"),
) -> None:
    """List the recordings of all jobs in a folder, oldest first."""
    table = Table("recording", "MB", "last write", "marked")
    for file in recordings(folder):
        size, written = f"{file.n_bytes / 1e6:.1f}", datetime.fromtimestamp(file.written_s)
        marked = "yes" if file.marked else ""
        table.add_row(plain_text(str(file.path)), size, f"{written:%Y-%m-%d %H:%M}", marked)
    print_table(table)
    if not table.row_count:
        print_note(f"{folder} has no recordings")


def mark(recordings: Annotated[list[Path], typer.Argument(help="Recordings (.mcap).")]) -> None:
    """Mark recordings, so that they are never deleted."""
    for path in recordings:
        print_line(f"{path}: marked by {mark_one(path).name} beside it")


def report(
    recording: Annotated[
        Path, typer.Argument(help="Recording of a run, an identification or a sort.")
    ],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Page to write [default: beside it].")
    ] = None,
) -> None:
    """Write the report page of a recording: one HTML file for a browser.

    Needs the extra `report`.
    """
    # The page of a run is beside its first recording.
    stem = "" if recording.stem == "recording" else f"{recording.stem}-"
    page = output or recording.with_name(f"{stem}report.html")
    write_report(page, recorded_report(read_recording(recording)))
    print_line(f"report: {page}")


def plot(
    number: Annotated[int, typer.Argument(min=0, help="Number of the grasp, from 0.")],
    source: Annotated[str, typer.Argument(help="Archive, data set or recording.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Picture to write (.png or .svg).")
    ],
    cells: options.Cells = None,
    days: options.Days = None,
    objects: options.Objects = None,
) -> None:
    """Draw a grasp: load, opening and force over time, and both pads.

    Needs the extra `report`; of an archive `archive` too.
    """
    selection = parse_selection(cells, days, objects)
    if is_archive(source):
        with extra("archive", needed_by="an archive"):
            from cell.archive.store import Archive
        every = Archive(source).grasps(selection)
    else:
        every = (grasp for grasp in read_grasps(source) if selection.fits(grasp))
    n_grasps = 0
    for n_grasps, grasp in enumerate(every, start=1):  # noqa: B007
        if n_grasps > number:
            break
    else:
        raise CellError(f"{source} has no grasp {number}: {n_grasps} are selected, from number 0")
    title = f"{grasp.label or 'no label'}, {cell_of(grasp)}, {day_of(grasp.start_ms)}"
    write_picture(output, grasp_figure(grasp, title))
    print_line(f"{title}: {output}")


def recover(
    recording: Annotated[Path, typer.Argument(help="Truncated or damaged recording.")],
    output: options.RecordingOut = None,
    json_file: options.Json = None,
) -> None:
    """Save the undamaged data of a damaged recording to a new file."""
    target = output or recording.with_name(f"{recording.stem}-recovered.mcap")
    old = recover_recording(recording, target)
    values = {
        "recording": target,
        "n_frames": len(old.frames),
        "n_cycles": len(old.cycles),
        "n_grasps": len(old.grasps),
        "n_broken_grasps": old.n_broken_grasps,
        "lost_reason": old.lost_reason,
    }
    lines = (
        f"{recording}: {old.lost_reason or 'complete, nothing is lost'}",
        f"{target}: {len(old.frames)} frames, {len(old.cycles)} periods of the loop, "
        f"{len(old.grasps)} whole grasps; {old.n_broken_grasps} broken grasps are left out",
    )
    show(lines, values, json_file)
