"""`model compare`: which of two models names the same grasps better."""

from pathlib import Path
from typing import Annotated

import typer

from cell.archive.compare import compare as compare_models
from cell.archive.selected_grasps import selected_grasps
from cell.archive.selection import parse_selection
from cell.interfaces.cli.options import (
    MOST_GRASPS,
    CellsOption,
    DaysOption,
    JobsOption,
    JsonOption,
    MostOption,
    ObjectsOption,
)
from cell.interfaces.cli.terminal import percent, print_line, show
from cell.learning.model import load_model
from cell.learning.parallel import workers


def compare(
    first: Annotated[Path, typer.Argument(help="File of a taught model.")],
    second: Annotated[Path, typer.Argument(help="File of another one.")],
    datasets: Annotated[
        list[str], typer.Argument(help="Archives, data sets or recordings that taught neither.")
    ],
    cells: CellsOption = None,
    days: DaysOption = None,
    objects: ObjectsOption = None,
    most: MostOption = MOST_GRASPS,
    jobs: JobsOption = 1,
    json_file: JsonOption = None,
) -> None:
    """Compare two models on the same grasps: paired, with an interval of 95 %."""
    models = load_model(first), load_model(second)
    selection = parse_selection(cells, days, objects)
    grasps = selected_grasps(datasets, selection, most, print_line)
    with workers(jobs) as mapper:
        found = compare_models(*models, grasps, mapper)
    only = (found.only_first, found.only_second)
    each = zip((first, second), found.right, found.wrong, only, strict=True)
    lines = [
        f"{path}: named rightly {percent(right)}, wrongly {percent(wrong)}; {alone} grasps "
        "that the other one does not name rightly"
        for path, right, wrong, alone in each
    ]
    gained = percent(found.difference, found.interval)
    show([*lines, f"{second} names {gained} more of {found.n} grasps rightly"], found, json_file)
