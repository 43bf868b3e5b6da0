"""`train`: trains a recogniser on recorded grasps and writes a model file."""

from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import JsonOption, ModelOutOption, RecognizerOption
from recognition.recognizers import DEFAULT_TRAINER


def train(
    datasets: Annotated[
        list[Path], typer.Argument(help="Data sets or recordings of labelled grasps.")
    ],
    model: ModelOutOption,
    recognizer: RecognizerOption = DEFAULT_TRAINER,
    aperture: Annotated[
        bool,
        typer.Option("--aperture/--no-aperture", help="Also use the opening of the fingers."),
    ] = True,
    early: Annotated[
        bool,
        typer.Option(
            "--early/--no-early",
            help="Also train on shortened ramps, for decide_early; takes 3 times as long.",
        ),
    ] = True,
    json_file: JsonOption = None,
) -> None:
    """Train a recogniser on data sets and write a model file."""
    from cell.errors import CellError
    from cell.interfaces.cli.terminal import print_line, print_note, write_json
    from cell.jobs.teach import duplicate_grasps, read_labelled_grasps
    from cell.learning.model import save_model
    from cell.learning.teaching_summary import summarise_teaching
    from cell.learning.training import train as train_model

    grasps = [grasp for path in datasets for grasp in read_labelled_grasps(path, print_line)]
    if not all(grasp.pads.same_as(grasps[0].pads) for grasp in grasps):
        raise CellError("the data sets are of different pads; train a model for each")
    if twice := len(duplicate_grasps(grasps)):
        print_note(f"{twice} of {len(grasps)} grasps occur twice: probabilities are too high")
    trained = train_model(grasps, recognizer, use_aperture=aperture, early=early)
    labels = trained.recognizer.labels
    save_model(
        model,
        trained.recognizer,
        trainer_name=recognizer,
        pads=grasps[0].pads,
        sections=trained.sections,
    )
    print_line(
        f"{len(labels)} objects taught with {len(grasps)} grasps"
        + ("" if recognizer == DEFAULT_TRAINER else f", recogniser {recognizer}")
        + f": {model}"
    )
    summary = summarise_teaching(grasps)
    for note in summary.notes:
        print_note(note)
    write_json(
        json_file,
        {
            "model": str(model),
            "recognizer": recognizer,
            "n_grasps": len(grasps),
            "early": trained.early is not None,
            "labels": list(labels),
            "teaching": summary.as_json(),
        },
    )
