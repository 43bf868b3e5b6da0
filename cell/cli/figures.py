"""Commands over recorded grasps: train, evaluate, replay."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from cell.choosing import memory_sections, remember_grasps
from cell.cli.options import CaptureOption, ConfigOption, JsonOption
from cell.cli.output import out, percent, progress_bar, say, write_json
from cell.config_file import load_config
from cell.dataset import read_dataset
from cell.early_heads import heads_sections, teach_heads
from cell.errors import CellError, ConfigError
from cell.jobs.evaluating import EvaluationResult, evaluate_recognizers
from cell.jobs.replaying import replay_grasps
from cell.jobs.teaching import repeated
from cell.jobs.teaching import train as train_recognizer
from cell.model import save_model
from cell.parallel import workers
from cell.recording import recording_grasps
from recognition.drift import NO_DRIFT, Drift, parse_drift
from recognition.grasp import Grasp
from recognition.recognizers import DEFAULT_TRAINER, TRAINERS, make_trainer, trainer_names

SplitOption = Annotated[
    str, typer.Option("--split", help="chronological:FRACTION or shuffled:FRACTION to train on.")
]
RecognizerOption = Annotated[
    str, typer.Option("--recognizer", help=f"One of {', '.join(trainer_names())}.")
]
ApertureOption = Annotated[
    bool, typer.Option("--aperture/--no-aperture", help="Use the opening of the fingers too.")
]

_MANY_GRASPS = 1000
"""From here on the processes that share the work take less time to start than they save."""


def train(
    datasets: Annotated[list[Path], typer.Argument(help="Data sets of labelled grasps.")],
    model: Annotated[Path, typer.Option("--output", "-o", help="Model file to write.")],
    recognizer: RecognizerOption = DEFAULT_TRAINER,
    aperture: ApertureOption = True,
    early: Annotated[
        bool, typer.Option("--early", help="Also teach with ramps cut short, for decide_early.")
    ] = False,
    poses: Annotated[
        bool,
        typer.Option(
            "--poses",
            help="Keep what each pose told, for sequence.kind: active; 5 x the time.",
        ),
    ] = False,
    json_file: JsonOption = None,
) -> None:
    """Train a recogniser on data sets and write a model file."""
    _check_recognizer(recognizer)
    grasps = [grasp for path in datasets for grasp in _labelled(path)]
    if not all(grasp.pads.same_as(grasps[0].pads) for grasp in grasps):
        raise CellError("the data sets were taken on different pads; train a model for each")
    if twice := len(repeated(grasps)):
        say(f"NOTE: {twice} of {len(grasps)} grasps stand twice and count as two: too sure")
    taught = train_recognizer(grasps, recognizer, use_aperture=aperture)
    heads = teach_heads(grasps, recognizer, taught, use_aperture=aperture) if early else None
    memory = None
    if poses:
        memory = remember_grasps(make_trainer(recognizer, use_aperture=aperture), grasps)
    save_model(
        model,
        taught,
        trainer_name=recognizer,
        pads=grasps[0].pads,
        sections={**heads_sections(heads), **memory_sections(memory)},
    )
    also = " and ".join(
        name for name, there in (("ramps cut short", early), ("poses", poses)) if there
    )
    say(
        f"{recognizer} taught {len(taught.labels)} objects with {len(grasps)} grasps"
        + (f", with {also}" if also else "")
        + f": {model}"
    )
    write_json(
        json_file,
        {
            "model": str(model),
            "recognizer": recognizer,
            "n_grasps": len(grasps),
            "early": early,
            "n_remembered": 0 if memory is None else len(memory.classes),
            "labels": list(taught.labels),
        },
    )


def evaluate(
    dataset: Annotated[Path, typer.Argument(help="Data set or recording of labelled grasps.")],
    train_on: Annotated[
        Path | None, typer.Option("--train", help="Train on this file and test on all of DATASET.")
    ] = None,
    split: SplitOption = "chronological:0.6",
    fuse: Annotated[str, typer.Option("--fuse", help="Numbers of grasps to fuse.")] = "1,2,3,5",
    recognizers: Annotated[
        list[str] | None,
        typer.Option(
            "--recognizer",
            help=f"Repeat for several, of {', '.join(trainer_names())} "
            f"[default: {', '.join(TRAINERS)}].",
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
    seed: Annotated[int, typer.Option("--seed", min=0)] = 0,
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
    """Measure recognisers on recorded grasps: accuracy with intervals, fusion, unknown objects."""
    names = recognizers or list(TRAINERS)
    for name in names:
        _check_recognizer(name)
    grasps = _labelled(dataset)
    taught = None if train_on is None else _labelled(train_on)
    if twice := len(repeated([*(taught or ()), *grasps])):
        say(f"NOTE: {twice} grasps are tested that were taught, or stand twice: right too often")
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


def replay(
    source: Annotated[Path, typer.Argument(help="Data set or recording.")],
    split: SplitOption = "chronological:0.6",
    limit: Annotated[
        int | None, typer.Option("--limit", min=1, help="Most grasps to replay [default: all].")
    ] = None,
    recognizer: RecognizerOption = DEFAULT_TRAINER,
    config: ConfigOption = None,
    capture: CaptureOption = None,
    json_file: JsonOption = None,
) -> None:
    """Send recorded grasps through the real protocols, receive, compare and identify them."""
    _check_recognizer(recognizer)
    with progress_bar() as progress:
        result = replay_grasps(
            _grasps(source),
            load_config(config) if config is not None else None,
            split=split,
            limit=limit,
            recognizer=recognizer,
            capture=capture,
            progress=progress,
        )
    same = "bit for bit the same" if result.frames_equal else "NOT the same"
    say(
        f"{result.n_grasps} grasps: {result.frames_sent} frames sent, "
        f"{result.frames_received} received, {same}"
    )
    say(f"openings differ by at most {result.aperture_error_m * 1e3:.3f} mm (servo pulses)")
    if result.accuracy is not None:
        say(f"{recognizer}, one grasp: {percent(result.accuracy, result.interval)}")
    say(f"{result.seconds:.1f} s")
    write_json(json_file, result.as_json())
    if not result.frames_equal:
        raise CellError(f"frames differ: {result.difference}")


def _grasps(path: Path) -> tuple[Grasp, ...]:
    grasps = recording_grasps(path) if path.suffix == ".mcap" else read_dataset(path)
    if not grasps:
        raise CellError(f"{path} holds no whole grasp")
    return grasps


def _labelled(path: Path) -> tuple[Grasp, ...]:
    """Return the grasps that say what was held: others can neither teach nor test."""
    grasps = _grasps(path)
    labelled = tuple(grasp for grasp in grasps if grasp.label)
    if not labelled:
        raise CellError(f"{path}: none of its {len(grasps)} grasps has a label")
    if len(labelled) < len(grasps):
        say(f"{path}: {len(grasps) - len(labelled)} grasps without a label are left out")
    return labelled


def _check_recognizer(name: str) -> None:
    if name not in trainer_names():
        raise ConfigError(
            f"no recogniser is named {name!r}; there are {', '.join(trainer_names())}"
        )


def _numbers(text: str) -> tuple[int, ...]:
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or min(numbers) < 1:
        raise ConfigError(f"--fuse is {text!r}; write numbers from 1, as 1,2,3,5")
    return numbers


def _in_words(drift: Drift) -> str:
    return f"gain {drift.gain:.2f}, opening {drift.aperture_offset_m * 1e3:+.1f} mm"


def _drift(text: str | None) -> Drift:
    if text is None:
        return NO_DRIFT
    try:
        return parse_drift(text)
    except ValueError as error:
        raise ConfigError(f"--drift: {error}") from error


def _print_evaluation(result: EvaluationResult) -> None:
    say(
        f"{result.split}: {result.n_train} grasps to train, {result.n_test} to test, "
        f"{len(result.labels)} objects"
    )
    if result.drift != NO_DRIFT:
        say(f"drift of the tested grasps: {_in_words(result.drift)}")
    if result.gauged is not None:
        found = _in_words(result.gauged.drift)
        say(f"gauged with {result.gauged.n_grasps} grasps of {result.gauge}: {found}")
    fused = sorted({k for f in result.recognizers.values() for k in f.full.fused_accuracy} - {1})
    table = Table(header_style="bold")
    table.add_column("recogniser", no_wrap=True)
    table.add_column("one grasp (95 %)", justify="right", no_wrap=True)
    for k in fused:
        table.add_column(f"{k} fused", justify="right", no_wrap=True)
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
                *(f"{100 * evaluation.fused_accuracy[k]:.1f}" for k in fused),
                f"{evaluation.unknown_auroc:.3f}",
            )
    out.print(table)
    say("per cent right; AUROC: objects left out of teaching told from taught ones")
    for name, figures in result.recognizers.items():
        shift = figures.full.shift
        if shift is not None:
            say(
                f"{name} in a shift of mixed objects, after its first {shift.before} grasps: "
                f"{percent(shift.accuracy, shift.interval)}, "
                f"{100 * shift.known_rejected:.1f} % called UNKNOWN"
            )
    say(f"{result.seconds:.1f} s")
