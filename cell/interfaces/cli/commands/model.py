"""`model`: trains, calibrates and evaluates recognizers."""

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from cell.archive.selection import EVERYTHING, is_archive, parse_selection
from cell.errors import CellError, ConfigError
from cell.evaluation import EvaluationResult, evaluate_recognizers, selected_grasps, with_spread
from cell.files import write_text
from cell.interfaces.cli import options
from cell.interfaces.cli.session import (
    RunningCell,
    cell_config,
    model_of_folder,
    pads_of,
    running_cell,
)
from cell.interfaces.cli.terminal import percent, print_line, print_note, progress_bar, show
from cell.learning.labelled_grasps import distinct_grasps
from cell.learning.model import LAST_MODEL, check_pads, load_model, save_model
from cell.learning.parallel import workers
from cell.learning.teaching_summary import teaching_notes
from cell.learning.training import calibrate_model, follow_shift, gaugeable, train as train_model
from cell.recording.dataset import read_grasps
from cell.runtime.goals import TeachGoal
from recognition.drift.drift import drift_text
from recognition.evaluation.evaluation import MIN_LABELS_FOR_UNKNOWN, Evaluation
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN
from recognition.recognizers import DEFAULT_TRAINER, trainer_names


def train(
    datasets: Annotated[
        list[str], typer.Argument(help="Archives, data sets or recordings of labelled grasps.")
    ],
    model: options.ModelOut,
    recognizer: options.Recognizer = DEFAULT_TRAINER,
    cells: options.Cells = None,
    days: options.Days = None,
    objects: options.Objects = None,
    json_file: options.Json = None,
) -> None:
    """Train a recognizer on data sets and write a model file."""
    selection = parse_selection(cells, days, objects)
    grasps = selected_grasps(datasets, selection, print_line)
    if not all(grasp.pads.same_as(grasps[0].pads) for grasp in grasps):
        raise CellError("the data sets are of different pads; train a model for each")
    distinct = distinct_grasps(grasps)
    if twice := len(grasps) - len(distinct):
        print_note(f"{twice} of {len(grasps)} grasps occur twice: probabilities are too high")
    trained = train_model(grasps, recognizer)
    prior = None
    if any(map(is_archive, datasets)):
        trained, prior = with_spread(trained, grasps)
    labels = trained.recognizer.labels
    save_model(model, trained, grasps)
    last = model.with_name(LAST_MODEL)
    write_text(last, f"{model.name}\n", error=CellError, what="name of the last model")
    lines = [
        f"{len(labels)} objects taught with {len(grasps)} grasps"
        + ("" if recognizer == DEFAULT_TRAINER else f", recognizer {recognizer}")
        + f": {model}"
    ]
    if prior is not None:
        lines.append(
            f"spread between days and cells: gain {100 * prior.log_gain_sd:.0f} %, opening "
            f"{prior.offset_sd_mm:.1f} mm"
        )
    notes = teaching_notes(distinct)
    values = {
        "model": str(model),
        "recognizer": recognizer,
        "n_grasps": len(grasps),
        "labels": list(labels),
        "notes": notes,
    }
    if prior is not None:
        spread = {"log_gain_sd": prior.log_gain_sd, "offset_sd_mm": prior.offset_sd_mm}
        values["spread"] = spread
    show(lines, values, json_file)
    for note in notes:
        print_note(note)


def calibrate(
    output: options.ModelOut,
    dataset: options.Grasps = None,
    gauge: Annotated[
        list[str] | None,
        typer.Option(
            "--gauge",
            metavar="NAME",
            help="Measure the drift on this taught object; repeat for a second one (better). "
            "Without it, DATASET has any grasps of a shift.",
        ),
    ] = None,
    model: options.FolderModel = None,
    grasps: Annotated[
        int, typer.Option("--grasps", "-n", min=1, max=100, metavar="N", help="Grasps of each.")
    ] = 3,
    config: options.Config = None,
    out_folder: options.Out = None,
    seed: options.Seed = None,
    json_file: options.Json = None,
) -> None:
    """Correct a model for the drift of the sensors since teaching.

    Uses known objects, or any grasps of a shift.
    """
    if (model := model_of_folder(model)) is None:
        raise ConfigError("--model is missing; `tactile-cell model train` makes one")
    gauge = gauge and [*dict.fromkeys(gauge)]
    loaded, taught_with = load_model(model), read_grasps(model)
    taken: dict[str, list[Grasp]] = {}
    cell: RunningCell | None = None
    if dataset is not None:
        recorded = list(read_grasps(dataset))
        if gauge:
            newest, n_all = max(recorded, key=lambda grasp: grasp.start_ms).zero, len(recorded)
            recorded = [grasp for grasp in recorded if grasp.zero == newest]
            if n_left := n_all - len(recorded):
                print_note(f"{dataset}: {n_left} grasps before the newest self-zero are left out")
        taken = {
            label: _grasps_of(label, recorded, dataset, alone=len(gauge or ()) == 1)
            for label in gauge or ()
        }
        corrected = calibrate_model(loaded, taken) if gauge else follow_shift(loaded, recorded)
        n_grasps = sum(map(len, taken.values())) if gauge else len(recorded)
    elif not gauge:
        raise ConfigError("the object is missing: add --gauge NAME, or name grasps of a shift")
    else:
        checked = cell_config(config, seed=seed)
        check_pads(loaded, pads_of(checked))
        gaugeable(loaded, *gauge)
        with running_cell(
            checked, "calibrate", out_folder, config_file=config, json_file=json_file
        ) as cell:
            for label in gauge:
                cell.run(TeachGoal(label=label, grasps=grasps, seed=checked.seed, train=False))
        for label in gauge:
            taken[label] = [g for g in cell.plugin.model.training_set if g.label == label]
        corrected = calibrate_model(loaded, taken)
        n_grasps = sum(map(len, taken.values()))
    save_model(output, replace(loaded, recognizer=corrected), taught_with)
    values = {"model": output, "gauge": gauge, **corrected.grid.values, "n_grasps": n_grasps}
    line = (
        f"{n_grasps} grasps of {' and '.join(gauge) if gauge else 'a shift'}: "
        f"{drift_text(corrected.grid.drift)} (±{1e3 * corrected.grid.offset_sd_m:.1f} mm): "
        f"{output}"
    )
    show([line], values, json_file)
    if cell is not None:
        cell.plugin.cell.check_recording()


def _grasps_of(gauge: str, grasps: list[Grasp], dataset: Path, *, alone: bool) -> list[Grasp]:
    """Return the grasps of a gauge; grasps without a label belong to it if it is the only one."""
    taken = [grasp for grasp in grasps if grasp.label in ({gauge, ""} if alone else {gauge})]
    if not taken:
        labels = ", ".join(sorted({repr(grasp.label) for grasp in grasps}))
        raise CellError(
            f"{dataset}: its {len(grasps)} grasps have no {gauge!r}, but {labels}; use a "
            "taught one of these for --gauge"
        )
    return taken


_PAIRS = 5
"""Number of pairs of confused objects that are printed, the most frequent first."""
_MANY_GRASPS = 1000
"""Number of grasps from which a process for each core saves more time than its start takes."""


def evaluate(
    datasets: Annotated[
        list[str], typer.Argument(help="Archives, data sets or recordings of labelled grasps.")
    ],
    train_on: Annotated[
        str | None, typer.Option("--train", help="Train on this file or archive, test on DATASETS.")
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            "--split",
            help="chronological:FRACTION to train on; or series, days, cells: each of them is left "
            "out in turn.",
        ),
    ] = "chronological:0.6",
    fuse: Annotated[
        list[int] | None,
        typer.Option(
            "--fuse",
            min=1,
            metavar="N",
            help="Grasps to fuse; repeat for several [default: 1, 2, 3, 5].",
        ),
    ] = None,
    recognizers: Annotated[
        list[str] | None,
        typer.Option(
            "--recognizer",
            metavar="NAME",
            help="Repeat for several kinds, as doctor lists them with --plugins "
            f"[default: {', '.join(trainer_names())}].",
            callback=options.known_recognizers,
        ),
    ] = None,
    cells: options.Cells = None,
    days: options.Days = None,
    objects: options.Objects = None,
    json_file: options.Json = None,
) -> None:
    """Measure recognizers on recorded grasps: accuracy, fusion, unknown objects.

    With 95 % intervals. For unknown objects, groups of objects are left out of training in turn.
    """
    names = recognizers or trainer_names()
    selection = parse_selection(cells, days, objects)
    grasps = selected_grasps(datasets, selection, print_line)
    taught = None
    if train_on is not None:
        taught = selected_grasps([train_on], EVERYTHING, print_line)
    every = [*(taught or ()), *grasps]
    if twice := len(every) - len(distinct_grasps(every)):
        print_note(f"{twice} grasps were taught or occur twice: the accuracy is too high")
    n_processes = 0 if len(grasps) >= _MANY_GRASPS else 1
    with workers(n_processes) as mapper, progress_bar() as progress:
        result = evaluate_recognizers(
            grasps,
            split=split,
            train=taught,
            names=names,
            fuse=fuse or (1, 2, 3, 5),
            mapper=mapper,
            progress=progress,
        )
    for name, reason in result.left_out.items():
        print_note(f"{name} is left out: {reason}")
    show(_lines(result), result.as_json(), json_file)


def _with_interval(
    value: float, interval: tuple[float, float], unit: float = 100.0, digits: int = 1
) -> str:
    if math.isnan(value):
        return "-"
    low, high = (f"{unit * end:.{digits}f}" for end in interval)
    return f"{unit * value:.{digits}f} ({low} to {high})"


def _lines(result: EvaluationResult) -> Iterator[str | Table]:
    yield (
        f"{result.split}: {result.n_train} grasps to train, {result.n_test} to test, "
        f"{len(result.labels)} objects"
    )
    fused = sorted({k for f in result.recognizers.values() for k in f.full.fused_accuracy} - {1})
    table = Table(header_style="bold")
    for column in (
        *("%", "likeliest right", *(f"{k} fused" for k in fused)),
        *("named right", "named wrong", UNKNOWN, "AUROC"),
    ):
        table.add_column(column, justify="right" if table.columns else "left")
    for name, figures in result.recognizers.items():
        rows = [(name, figures.full)]
        if figures.without_aperture != figures.full:
            rows.append(("  tactile only", figures.without_aperture))
        for title, test in rows:
            named = (test.named_right, test.named_wrong, 1.0 - test.named_right - test.named_wrong)
            table.add_row(
                title,
                _with_interval(test.single_accuracy, test.interval),
                *(_with_interval(test.fused_accuracy[k], test.fused_interval[k]) for k in fused),
                *(f"{abs(100 * share):.1f}" for share in named),
                _with_interval(test.unknown_auroc, test.auroc_interval, 1.0, 3),
            )
    yield table
    yield (
        "AUROC: separation of taught objects from objects left out of teaching; 1 is perfect, 0.5 "
        "is chance. Names and AUROC are of one grasp. Intervals at 95 % count objects, not grasps, "
        "and no fused grasp counts twice"
    )
    if any(math.isnan(f.full.unknown_auroc) for f in result.recognizers.values()):
        yield (
            f"-: not measured; AUROC leaves out one object and teaches the others. It needs "
            f"{MIN_LABELS_FOR_UNKNOWN} taught and tested objects and a split within each"
        )
    for name, figures in result.recognizers.items():
        yield from _details(name, figures.full)


def _details(name: str, evaluation: Evaluation) -> Iterator[str]:
    """Yield the confusions of a recognizer, and its figures with drift correction."""
    if pairs := evaluation.confused:
        listed = [f"{n} x {truth} as {answer}" for truth, answer, n in pairs[:_PAIRS]]
        rest = f", and {len(pairs) - _PAIRS} more pairs" if len(pairs) > _PAIRS else ""
        yield f"{name} confuses, one grasp each: {', '.join(listed)}{rest}"
    shift = evaluation.shift
    if shift is not None:
        yield (
            f"{name} with drift correction, after the first {shift.before}: "
            f"{percent(shift.accuracy, shift.interval)}, "
            f"named rightly {100 * shift.named_right:.1f} %, wrongly "
            f"{100 * shift.named_wrong:.1f} %"
        )
