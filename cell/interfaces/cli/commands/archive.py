"""`archive`: grasps of many cells and days as one table: add, report."""

from pathlib import Path
from typing import Annotated

import typer

from cell.archive.selection import parse_selection
from cell.installation import extra
from cell.interfaces.cli import options
from cell.interfaces.cli.terminal import print_note, progress_bar, show
from cell.learning.parallel import workers
from cell.report.page import write_report

ArchiveArgument = Annotated[str, typer.Argument(help="Folder or URL of the archive.")]


def add(
    places: Annotated[
        list[Path], typer.Argument(help="Folders, recordings or data sets; folders with all below.")
    ],
    target: Annotated[str, typer.Option("--to", help="Folder or URL (fsspec) of the archive.")],
    cell: Annotated[
        str, typer.Option("--cell", help="Name of the cell, for grasps without one.")
    ] = "",
    jobs: Annotated[
        int, typer.Option("--jobs", min=0, metavar="N", help="Processes; 0: one per core.")
    ] = 1,
    json_file: options.Json = None,
) -> None:
    """Add the new grasps of recordings and data sets to an archive.

    Needs the extra `archive`.
    """
    with extra("archive", needed_by="the archive"):
        from cell.archive.ingest import ingest, sources

    paths = sources(places)
    with workers(jobs) as mapper, progress_bar() as progress:
        done = ingest(target, paths, cell=cell, mapper=mapper, progress=progress)
    for path, why in done.left.items():
        print_note(f"left for the next run: {why if path in why else f'{path}: {why}'}")
    line = (
        f"{done.n_grasps} grasps of {done.n_files} files added to {target}; {done.n_there} files "
        f"and {done.n_before} grasps were there already"
    )
    show([line], done, json_file)


def report(
    archive: ArchiveArgument,
    output: Annotated[Path, typer.Option("--output", "-o", help="Page to write.")] = Path(
        "archive.html"
    ),
    cells: options.Cells = None,
    days: options.Days = None,
    objects: options.Objects = None,
    json_file: options.Json = None,
) -> None:
    """Report confused objects, drifting cells, ageing pads and objects with few grasps.

    Needs the extras `archive` and `report`.
    """
    with extra("archive", needed_by="the archive"):
        from cell.archive.page import archive_report, lines
        from cell.archive.questions import ask

    answers = ask(archive, parse_selection(cells, days, objects))
    write_report(output, archive_report(answers, archive))
    show([*lines(answers), f"report: {output}"], answers.as_json(), json_file)
