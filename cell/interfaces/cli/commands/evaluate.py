"""`model evaluate`: measures recognisers on recorded grasps."""

import math
from collections.abc import Iterator
from typing import Annotated

import typer
from rich.table import Table

from cell.archive.evaluate import EvaluationResult, evaluate_recognizers
from cell.archive.selected_grasps import selected_grasps
from cell.archive.selection import EVERYTHING, parse_selection
from cell.errors import ConfigError, raised_as
from cell.interfaces.cli.options import (
    MAX_SEED,
    MOST_GRASPS,
    CellsOption,
    DaysOption,
    JsonOption,
    MostOption,
    ObjectsOption,
    known_recognizers,
)
from cell.interfaces.cli.terminal import (
    percent,
    print_line,
    print_note,
    progress_bar,
    show,
)
from cell.learning.labelled_grasps import duplicate_grasps
from cell.learning.parallel import workers
from recognition.drift.drift import NO_DRIFT, Drift, drift_text, parse_drift
from recognition.evaluation.evaluation import Evaluation
from recognition.recognizer import UNKNOWN
from recognition.recognizers import trainer_names

_PAIRS = 5
"""Number of pairs of confused objects that are printed, the most frequent first."""
_MANY_GRASPS = 1000
"""Number of grasps from which several processes save more time than their start takes."""


def evaluate(
    datasets: Annotated[
        list[str], typer.Argument(help="Archives, data sets or recordings of labelled grasps.")
    ],
    train_on: Annotated[
        str | None,
        typer.Option("--train", help="Train on this file or archive, test on all of DATASETS."),
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            "--split",
            help="chronological:FRACTION or shuffled:FRACTION to train on. Or leave out in turn "
            "series: each one of an object that has several; days, cells: each of them.",
        ),
    ] = "chronological:0.6",
    fuse: Annotated[str, typer.Option("--fuse", help="Numbers of grasps to fuse.")] = "1,2,3,5",
    recognizers: Annotated[
        list[str] | None,
        typer.Option(
            "--recognizer",
            help="Repeat for several kinds, as doctor lists them with --plugins "
            f"[default: {', '.join(trainer_names())}].",
            callback=known_recognizers,
        ),
    ] = None,
    drift: Annotated[
        str | None,
        typer.Option(
            "--drift", help="Add a drift to the tested grasps, for example gain=0.7,aperture_mm=-4."
        ),
    ] = None,
    gauge: Annotated[
        str | None,
        typer.Option("--gauge", help="Find the drift from the first 3 tested grasps of LABEL."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, max=MAX_SEED)] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            min=0,
            help="Processes, 0: one for each core [default: 0 from 1000 grasps, else 1].",
        ),
    ] = None,
    cells: CellsOption = None,
    days: DaysOption = None,
    objects: ObjectsOption = None,
    most: MostOption = MOST_GRASPS,
    json_file: JsonOption = None,
) -> None:
    """Measure recognisers on recorded grasps: accuracy, fusion, unknown objects.

    With 95 % intervals. Unknown objects are left out of teaching.
    """
    names = recognizers or trainer_names()
    selection = parse_selection(cells, days, objects)
    grasps = selected_grasps(datasets, selection, most, print_line)
    taught = None
    if train_on is not None:
        taught = selected_grasps([train_on], EVERYTHING, most, print_line)
    if twice := len(duplicate_grasps([*(taught or ()), *grasps])):
        print_note(f"{twice} tested grasps were taught or occur twice: the accuracy is too high")
    if jobs is None:
        jobs = 0 if len(grasps) >= _MANY_GRASPS else 1
    with workers(jobs) as mapper, progress_bar() as progress:
        result = evaluate_recognizers(
            grasps,
            split=split,
            train=taught,
            names=names,
            fuse=_numbers(fuse),
            seed=seed,
            mapper=mapper,
            drift=_drift(drift),
            gauge=gauge,
            progress=progress,
        )
    for name, reason in result.left_out.items():
        print_note(f"{name} is left out: {reason}")
    show(_lines(result), result.as_json(), json_file)


def _numbers(text: str) -> tuple[int, ...]:

    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or min(numbers) < 1:
        raise ConfigError(f"--fuse is {text!r}; write numbers from 1, for example 1,2,3,5")
    return numbers


def _with_interval(
    value: float, interval: tuple[float, float], unit: float = 100.0, digits: int = 1
) -> str:
    if math.isnan(value):
        return "-"
    low, high = (f"{unit * end:.{digits}f}" for end in interval)
    return f"{unit * value:.{digits}f} ({low} to {high})"


def _drift(text: str | None) -> Drift:

    if text is None:
        return NO_DRIFT
    with raised_as(ConfigError, ValueError, where="--drift"):
        return parse_drift(text)


def _lines(result: EvaluationResult) -> Iterator[str | Table]:

    yield (
        f"{result.split}: {result.n_train} grasps to train, {result.n_test} to test, "
        f"{len(result.labels)} objects"
    )
    if result.drift != NO_DRIFT:
        yield f"drift of the tested grasps: {drift_text(result.drift)}"
    if result.gauged is not None:
        found = drift_text(result.gauged.drift)
        yield f"gauged with {result.n_gauged} grasps of {result.gauge}: {found}"
    fused = sorted({k for f in result.recognizers.values() for k in f.full.fused_accuracy} - {1})
    right, named = Table(header_style="bold"), Table(header_style="bold")
    for table, columns in (
        (
            right,
            ("likeliest right, %", "one grasp", "95 % interval", *(f"{k} fused" for k in fused)),
        ),
        (named, ("one grasp, %", "named right", "named wrong", UNKNOWN, "AUROC")),
    ):
        for column in columns:
            table.add_column(column, justify="left" if column is columns[0] else "right")
    for name, figures in result.recognizers.items():
        rows = [(name, figures.full)]
        if figures.without_aperture not in (None, figures.full):
            rows.append(("  tactile only", figures.without_aperture))
        for shown, evaluation in rows:
            low, high = evaluation.interval
            right.add_row(
                shown,
                f"{100 * evaluation.single_accuracy:.1f}",
                f"{100 * low:.1f} to {100 * high:.1f}",
                *(
                    _with_interval(evaluation.fused_accuracy[k], evaluation.fused_interval[k])
                    for k in fused
                ),
            )
            named.add_row(
                shown,
                f"{100 * evaluation.named_right:.1f}",
                f"{100 * evaluation.named_wrong:.1f}",
                f"{100 * (1.0 - evaluation.named_right - evaluation.named_wrong):.1f}",
                _with_interval(evaluation.unknown_auroc, evaluation.auroc_interval, 1.0, 3),
            )
    yield right
    yield named
    yield (
        "AUROC: separation of taught objects from objects left out of teaching; 1 is perfect, 0.5 "
        "is chance. Intervals at 95 % draw objects, not grasps, and no fused grasp counts twice"
    )
    if any(math.isnan(f.full.unknown_auroc) for f in result.recognizers.values()):
        yield (
            f"-: not measured; AUROC leaves out one object and teaches the others. It needs three "
            f"objects (here {len(result.labels)}) and a split within each"
        )
    for name, figures in result.recognizers.items():
        yield from _details(name, figures.full)
    yield f"took {result.seconds:.1f} s"


def _details(name: str, evaluation: Evaluation) -> Iterator[str | Table]:
    """Yield the confusions of a recogniser, its `unknown` and its figures with drift correction."""
    if pairs := evaluation.confused:
        shown_pairs = [f"{n} x {truth} as {answer}" for truth, answer, n in pairs[:_PAIRS]]
        rest = f", and {len(pairs) - _PAIRS} more pairs" if len(pairs) > _PAIRS else ""
        yield f"{name} confuses, one grasp each: {', '.join(shown_pairs)}{rest}"
    rows = [row for row in evaluation.unknown_reliability if row[2]]
    if rows:
        shares = (
            f"{low:g} to {high:g}: {100 * new / n:.0f} % of {n}" for low, high, n, new in rows
        )
        yield f"{name}, unknown and share of left-out objects there: {', '.join(shares)}"
    shift = evaluation.shift
    if shift is not None:
        yield (
            f"{name} with drift correction, after the first {shift.before}: "
            f"{percent(shift.accuracy, shift.interval)}, "
            f"named rightly {100 * shift.named_right:.1f} %, wrongly "
            f"{100 * shift.named_wrong:.1f} %"
        )
