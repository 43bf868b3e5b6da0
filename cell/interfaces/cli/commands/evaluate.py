"""`evaluate`: measures recognisers on recorded grasps."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cell.interfaces.cli.options import MAX_SEED, JsonOption, known_recognizers
from recognition.recognizers import TRAINERS, trainer_names

if TYPE_CHECKING:
    from cell.jobs.evaluate import EvaluationResult
    from recognition.drift.drift import Drift

_MANY_GRASPS = 1000
"""From here on the processes that share the work take less time to start than they save."""


def evaluate(
    datasets: Annotated[
        list[Path], typer.Argument(help="Data sets or recordings of labelled grasps.")
    ],
    train_on: Annotated[
        Path | None,
        typer.Option("--train", help="Train on this file and test on all of DATASETS."),
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            "--split",
            help="chronological:FRACTION or shuffled:FRACTION to train on, or series: each series "
            "of an object that has several is left out in turn.",
        ),
    ] = "chronological:0.6",
    fuse: Annotated[str, typer.Option("--fuse", help="Numbers of grasps to fuse.")] = "1,2,3,5",
    recognizers: Annotated[
        list[str] | None,
        typer.Option(
            "--recognizer",
            help=f"Repeat for several, of {', '.join(trainer_names())} "
            f"[default: {', '.join(TRAINERS)}].",
            callback=known_recognizers,
        ),
    ] = None,
    drift: Annotated[
        str | None,
        typer.Option("--drift", help="Drift of the tested grasps, as gain=0.7,aperture_mm=-4."),
    ] = None,
    gauge: Annotated[
        str | None,
        typer.Option("--gauge", help="Find the drift from the first 3 tested grasps of LABEL."),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, max=MAX_SEED)] = 0,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs", min=0, help="Processes, 0: one a core [default: 0 from 1000 grasps, else 1]."
        ),
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", help="Address of a Dask scheduler to work on.")
    ] = None,
    json_file: JsonOption = None,
) -> None:
    """Measure recognisers on recorded grasps: accuracy, fusion, unknown.

    With intervals of 95 %; unknown objects are those left out of teaching.
    """
    from cell.interfaces.cli.grasps import labelled_grasps
    from cell.interfaces.cli.terminal import print_note, progress_bar, write_json
    from cell.jobs.evaluate import evaluate_recognizers
    from cell.jobs.parallel import workers
    from cell.jobs.teach import repeated

    names = recognizers or list(TRAINERS)
    grasps = [grasp for path in datasets for grasp in labelled_grasps(path)]
    taught = None if train_on is None else labelled_grasps(train_on)
    if twice := len(repeated([*(taught or ()), *grasps])):
        print_note(f"{twice} grasps are tested that were taught, or stand twice: right too often")
    if jobs is None:
        jobs = 0 if len(grasps) >= _MANY_GRASPS else 1
    with workers(jobs, scheduler=scheduler) as mapper, progress_bar() as progress:
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
    _print_evaluation(result)
    write_json(json_file, result.as_json())


def _numbers(text: str) -> tuple[int, ...]:
    from cell.errors import ConfigError

    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or min(numbers) < 1:
        raise ConfigError(f"--fuse is {text!r}; write numbers from 1, as 1,2,3,5")
    return numbers


def _figure(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def _drift(text: str | None) -> "Drift":
    from cell.errors import ConfigError
    from recognition.drift.drift import NO_DRIFT, parse_drift

    if text is None:
        return NO_DRIFT
    try:
        return parse_drift(text)
    except ValueError as error:
        raise ConfigError(f"--drift: {error}") from error


def _print_evaluation(result: "EvaluationResult") -> None:
    from rich.table import Table

    from cell.interfaces.cli.terminal import out, percent, print_line
    from recognition.drift.drift import NO_DRIFT, drift_text

    print_line(
        f"{result.split}: {result.n_train} grasps to train, {result.n_test} to test, "
        f"{len(result.labels)} objects"
    )
    if result.drift != NO_DRIFT:
        print_line(f"drift of the tested grasps: {drift_text(result.drift)}")
    if result.gauged is not None:
        found = drift_text(result.gauged.drift)
        print_line(f"gauged with {result.n_gauged} grasps of {result.gauge}: {found}")
    fused = sorted({k for f in result.recognizers.values() for k in f.full.fused_accuracy} - {1})
    table = Table(header_style="bold")
    table.add_column("recogniser", no_wrap=True)
    table.add_column("one grasp (95 %)", justify="right", no_wrap=True)
    for k in fused:
        table.add_column(f"{k} fused", justify="right", no_wrap=True)
    table.add_column("named, wrong", justify="right", no_wrap=True)
    table.add_column("AUROC", justify="right", no_wrap=True)
    for name, figures in result.recognizers.items():
        rows = [(name, figures.full)]
        if figures.without_aperture not in (None, figures.full):
            rows.append(("  tactile only", figures.without_aperture))
        for shown, evaluation in rows:
            low, high = evaluation.interval
            table.add_row(
                shown,
                f"{100 * evaluation.single_accuracy:.1f} ({100 * low:.1f}-{100 * high:.1f})",
                *(_figure(100 * evaluation.fused_accuracy[k], 1) for k in fused),
                f"{100 * evaluation.named_right:.1f}, {100 * evaluation.named_wrong:.1f}",
                _figure(evaluation.unknown_auroc, 3),
            )
    out.print(table)
    print_line(
        "per cent right, whatever the probability of a new object; named, wrong: per cent that one"
        " grasp names rightly and wrongly; AUROC: how well objects left out of teaching are found"
    )
    if any(math.isnan(f.full.unknown_auroc) for f in result.recognizers.values()):
        print_line(
            f"-: not measured; AUROC leaves out one object and teaches the others, which takes "
            f"three objects (here {len(result.labels)}) and a split within each"
        )
    for name, figures in result.recognizers.items():
        shift = figures.full.shift
        if shift is not None:
            print_line(
                f"{name} in a shift of mixed objects, after its first {shift.before} grasps: "
                f"{percent(shift.accuracy, shift.interval)}, "
                f"{100 * shift.known_rejected:.1f} % called UNKNOWN"
            )
    print_line(f"{result.seconds:.1f} s")
