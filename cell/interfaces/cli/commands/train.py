"""`model train`: trains a recogniser on recorded grasps and writes a model file."""

from typing import Annotated

import typer

from cell.archive.selected_grasps import selected_grasps
from cell.archive.selection import is_archive, parse_selection
from cell.archive.spread import spread_gains, spread_values, with_spread
from cell.errors import CellError
from cell.interfaces.cli.options import (
    MOST_GRASPS,
    CellsOption,
    DaysOption,
    JobsOption,
    JsonOption,
    ModelOutOption,
    MostOption,
    ObjectsOption,
    RecognizerOption,
)
from cell.interfaces.cli.terminal import (
    percent,
    print_line,
    print_note,
    progress_bar,
    show,
)
from cell.learning.labelled_grasps import duplicate_grasps
from cell.learning.model import save_model
from cell.learning.parallel import workers
from cell.learning.teaching_summary import summarise_teaching
from cell.learning.training import train as train_model
from recognition.recognizers import DEFAULT_TRAINER


def train(
    datasets: Annotated[
        list[str], typer.Argument(help="Archives, data sets or recordings of labelled grasps.")
    ],
    model: ModelOutOption,
    recognizer: RecognizerOption = DEFAULT_TRAINER,
    aperture: Annotated[
        bool,
        typer.Option("--aperture/--no-aperture", help="Also use the opening of the fingers."),
    ] = True,
    spread: Annotated[
        bool | None,
        typer.Option(
            "--spread/--no-spread",
            help="Learn how far days and cells lie apart, and measure what that gains on those "
            "left out in turn [default: with archives].",
        ),
    ] = None,
    cells: CellsOption = None,
    days: DaysOption = None,
    objects: ObjectsOption = None,
    most: MostOption = MOST_GRASPS,
    jobs: JobsOption = 1,
    json_file: JsonOption = None,
) -> None:
    """Train a recogniser on data sets and write a model file."""
    selection = parse_selection(cells, days, objects)
    grasps = selected_grasps(datasets, selection, most, print_line)
    if not all(grasp.pads.same_as(grasps[0].pads) for grasp in grasps):
        raise CellError("the data sets are of different pads; train a model for each")
    if twice := len(duplicate_grasps(grasps)):
        print_note(f"{twice} of {len(grasps)} grasps occur twice: probabilities are too high")
    trained = train_model(grasps, recognizer, use_aperture=aperture)
    prior, gains = None, []
    if any(map(is_archive, datasets)) if spread is None else spread:
        trained, prior = with_spread(trained, grasps)
    if prior is not None:
        with workers(jobs) as mapper, progress_bar() as progress:
            gains = spread_gains(
                grasps, recognizer, use_aperture=aperture, mapper=mapper, progress=progress
            )
    elif spread:
        print_note(
            "no spread is learnt: it takes the default recogniser, grasps without a self-zero, "
            "and objects of several days or cells"
        )
    labels = trained.recognizer.labels
    save_model(
        model,
        trained.recognizer,
        trainer_name=recognizer,
        pads=grasps[0].pads,
    )
    lines = [
        f"{len(labels)} objects taught with {len(grasps)} grasps"
        + ("" if recognizer == DEFAULT_TRAINER else f", recogniser {recognizer}")
        + f": {model}"
    ]
    if prior is not None:
        lines.append(
            f"spread between days and cells: gain {100 * prior.log_gain_sd:.0f} %, opening "
            f"{prior.offset_sd_mm:.1f} mm"
        )
    lines += [
        f"{one.n} grasps of {one.n_parts} {one.what} left out in turn: named rightly "
        f"{percent(one.right_without)} without it, {percent(one.right)} with it, a difference "
        f"of {percent(one.gained, one.interval)}; wrongly {percent(one.wrong_without)} and "
        f"{percent(one.wrong)}"
        for one in gains
    ]
    summary = summarise_teaching(grasps)
    values = {
        "model": str(model),
        "recognizer": recognizer,
        "n_grasps": len(grasps),
        "labels": list(labels),
        "teaching": summary,
    }
    spread_found = {} if prior is None else {"spread": spread_values(prior, gains)}
    show(lines, values | spread_found, json_file)
    for note in summary.notes:
        print_note(note)
