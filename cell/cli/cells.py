"""Commands that move a cell: run, teach, identify, release."""

from pathlib import Path
from typing import Annotated

import typer

from cell.build import build_cell
from cell.choosing import memory_for
from cell.cli.asking import ask
from cell.cli.drawings import (
    GaugeOption,
    GaugeShapeOption,
    MeshOption,
    ShapeOption,
    teach_from_drawing,
)
from cell.cli.options import (
    CaptureOption,
    ConfigOption,
    FaultOption,
    JsonOption,
    ModelOption,
    OutOption,
    SeedOption,
)
from cell.cli.output import confusion_table, out, percent, progress_bar, say, write_json
from cell.cli.running import faulted, pads_of, running_cell, seeded
from cell.cli.stopping import END_WITHIN_S, stopping
from cell.config import CellConfig
from cell.config_file import load_config
from cell.early_heads import loaded_heads
from cell.errors import ConfigError, DatasetError
from cell.jobs.files import job_folder
from cell.jobs.main_job import teach_and_identify
from cell.jobs.main_report import main_report, shape_rows
from cell.jobs.main_result import MainResult
from cell.jobs.teaching import append_to_dataset, dataset_to_extend
from cell.jobs.teaching import teach as teach_object
from cell.labels import checked_label
from cell.model import load_model
from cell.paper import TABLE_1, TABLE_1_LABELS
from cell.report_shapes import shapes_view

ObjectsOption = Annotated[
    list[str] | None,
    typer.Option("--object", "-o", help="Object; repeat for several [default: all configured]."),
]


def run(
    config: ConfigOption = None,
    objects: ObjectsOption = None,
    teach_grasps: Annotated[
        int, typer.Option("--teach", min=3, max=1000, help="Grasps taught of each object.")
    ] = 20,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=1000, help="Identifications of each object.")
    ] = 10,
    model: ModelOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    capture: CaptureOption = None,
    faults: FaultOption = None,
    json_file: JsonOption = None,
) -> None:
    """Teach objects and identify them: the main job, on the configured or the simulated cell."""
    checked = faulted(seeded(load_config(config), seed), faults)
    loaded = None if model is None else load_model(model, pads_of(checked))
    recognizer = None if loaded is None else loaded.recognizer
    early = None if loaded is None else loaded_heads(loaded, checked.sequence)
    if loaded is not None:
        checked = _recognizing(checked, loaded.trainer_name)
    configured = [entry.label for entry in checked.simulator.objects]
    if checked.positioner.kind == "simulated":
        labels = objects or (list(recognizer.labels) if recognizer else configured)
        strange = [label for label in labels if label not in configured]
        if strange:
            raise ConfigError(
                f"the simulated cell has no object {', '.join(strange)}; "
                f"it has {', '.join(configured)}"
            )
    else:
        labels = objects or []
        if not labels:
            raise ConfigError("name the objects that are at hand, as --object ball --object box")
    memory = None if loaded is None else memory_for(checked.sequence, loaded)
    folder = job_folder(out_folder or Path(checked.recording.directory), "run")
    with (
        running_cell(checked, folder, capture, json_file=json_file) as cell,
        progress_bar() as progress,
    ):
        result = teach_and_identify(
            cell,
            checked,
            labels=labels,
            n_teach=teach_grasps,
            n_trials=trials,
            folder=folder,
            progress=progress,
            recognizer=recognizer,
            early=early,
            memory=memory,
        )
        result.extra = {"health": cell.health()}
        result.report = main_report(result, checked, cell, folder / "report.html")
    _print_main(result)
    write_json(json_file, result.as_json())


def teach(
    label: Annotated[str, typer.Argument(help="Name of the object.")],
    dataset: Annotated[Path, typer.Option("--output", "-o", help="Data set to write or extend.")],
    grasps: Annotated[
        int | None,
        typer.Option("--grasps", "-n", min=1, max=1000, help="[default: 20, of a drawing 60]"),
    ] = None,
    shape: ShapeOption = None,
    mesh: MeshOption = None,
    gauge: GaugeOption = None,
    gauge_shape: GaugeShapeOption = None,
    config: ConfigOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    faults: FaultOption = None,
    json_file: JsonOption = None,
) -> None:
    """Grasp a known object several times, or a drawing of it, and add that to a data set."""
    try:
        checked_label(label)
    except ValueError as error:
        raise ConfigError(str(error)) from error
    checked = faulted(seeded(load_config(config), seed), faults)
    if shape is not None or mesh is not None:
        if faults:
            raise ConfigError("--fault is for the simulated cell; a drawing has no faults")
        teach_from_drawing(
            checked,
            label,
            dataset,
            shape=shape,
            mesh=mesh,
            n_grasps=grasps,
            gauge=gauge,
            gauge_text=gauge_shape,
            json_file=json_file,
        )
        return
    if gauge is not None or gauge_shape is not None:
        raise ConfigError("a gauge serves drawings: add --shape or --mesh")
    before = dataset_to_extend(dataset, pads_of(checked))
    folder = job_folder(out_folder or Path(checked.recording.directory), "teach")
    with running_cell(checked, folder, json_file=json_file) as cell, progress_bar() as progress:
        records = teach_object(
            cell, checked, label, grasps or 20, seed=checked.seed + len(before), progress=progress
        )
        recording = cell.recording_path
    try:
        append_to_dataset(dataset, before, [record.grasp for record in records])
    except DatasetError as error:
        raise DatasetError(f"{error}; the grasps are in {recording}, which train takes") from error
    say(f"{len(records)} grasps of {label} added to {dataset} ({len(before)} were there)")
    say(f"recording: {recording}")
    write_json(
        json_file,
        {
            "label": label,
            "n_grasps": len(records),
            "dataset": str(dataset),
            "recording": str(recording),
        },
    )


def release(
    config: ConfigOption = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="The part may fall; say that this is meant.")
    ] = False,
) -> None:
    """Let go of a part that is still in the grip of an earlier run, and open the fingers."""
    if not confirm:
        raise ConfigError("the part may fall; add --confirm if that is meant")
    cell = build_cell(load_config(config), mover=lambda _pose: False, ask=ask)
    try:
        with stopping(cell.controller.cancel, end_within_s=END_WITHIN_S):
            cell.controller.release_held()
    finally:
        cell.close()
    say("released; the fingers are open")


def _recognizing(config: CellConfig, trainer_name: str) -> CellConfig:
    """Return the config with the kind of recogniser that a model file holds."""
    recognition = config.recognition.model_copy(update={"recognizer": trainer_name})
    return config.model_copy(update={"recognition": recognition})


def _print_main(result: MainResult) -> None:
    if set(result.labels) == set(TABLE_1_LABELS):
        order = [TABLE_1_LABELS.index(label) for label in result.labels]
        rows = [[TABLE_1[row][column] for column in order] for row in order]
        say("Paper, Table 1 (per cent)")
        out.print(confusion_table(result.labels, rows))
    for name, score in result.scores.items():
        say(f"{name}: {percent(score.accuracy, score.interval)} of {score.n}")
        out.print(confusion_table(result.labels, score.confusion))
    ended = f", {result.n_ended_early} ended early" if result.n_ended_early else ""
    say(f"{result.grasp_s:.2f} s a grasp, mean of {len(result.records)}{ended}")
    for remark in result.remarks:
        say(remark)
    shapes = shapes_view(shape_rows(result))
    for group in [] if shapes is None else shapes["groups"]:
        sizes = f"; {group['text']}" if group["text"] else ""
        say(f"{group['label']} felt like: {group['kinds']}{sizes}")
    say(f"report:    {result.report}")
    say(f"recording: {result.recording}")
    if result.dataset is not None:
        say(f"data set:  {result.dataset}")
        say(f"model:     {result.model}")
    say(f"{result.seconds:.1f} s")
