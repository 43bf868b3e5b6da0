"""`plot grasp`, `plot confusion`: pictures of an archive or of files of grasps."""

from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import CellsOption, DaysOption, ObjectsOption

app = typer.Typer(no_args_is_help=True, help="Pictures (PNG, SVG): grasp, confusion.")
PictureOption = Annotated[
    Path, typer.Option("--output", "-o", help="Picture to write (.png or .svg).")
]


@app.command()
def grasp(
    number: Annotated[int, typer.Argument(min=0, help="Number of the grasp, from 0.")],
    source: Annotated[str, typer.Argument(help="Archive, data set or recording.")],
    output: PictureOption,
    cells: CellsOption = None,
    days: DaysOption = None,
    objects: ObjectsOption = None,
) -> None:
    """Draw one of the selected grasps: load, opening and force over time, and both pads.

    Needs the extra `report`; of an archive `archive` too.
    """
    from cell.archive.selection import cell_of, day_of, is_archive, parse_selection
    from cell.data.dataset import read_grasps
    from cell.errors import CellError
    from cell.installation import extra
    from cell.interfaces.cli.terminal import print_line
    from cell.report.figures import grasp_figure, write_picture

    selection = parse_selection(cells, days, objects)
    if is_archive(source):
        with extra("archive", needed_by="an archive"):
            from cell.archive.store import Archive
        every = Archive(source).grasps(selection)
    else:
        every = (one for one in read_grasps(source) if selection.fits(one))
    found = next(islice(every, number, None), None)
    if found is None:
        raise CellError(f"{source} has no grasp {number} among the selected ones")
    title = f"{found.label or 'no label'}, {cell_of(found)}, {day_of(found.start_ms)}"
    write_picture(output, grasp_figure(found, title))
    print_line(f"{title}: {output}")


@app.command()
def confusion(
    archive: Annotated[str, typer.Argument(help="Folder or URL of the archive.")],
    output: PictureOption,
    cells: CellsOption = None,
    days: DaysOption = None,
    objects: ObjectsOption = None,
) -> None:
    """Draw what was held against what was named, of all identifications of named parts.

    Needs the extras `archive` and `report`.
    """
    from cell.archive.selection import parse_selection
    from cell.errors import CellError
    from cell.installation import extra
    from cell.interfaces.cli.terminal import print_line
    from cell.report.figures import confusion_figure, write_picture

    with extra("archive", needed_by="an archive"):
        from cell.archive.page import confusion_table
        from cell.archive.questions import ask

    table = confusion_table(ask(archive, parse_selection(cells, days, objects)))
    if table is None:
        raise CellError(
            f"{archive} has no selected identification of a part that was named; "
            f"`tactile-cell evaluate {archive}` measures confusions on taught grasps"
        )
    write_picture(output, confusion_figure(table))
    print_line(f"{table.text}: {output}")
