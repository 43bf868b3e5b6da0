"""`identify`: names the object in the grip, or the objects of recorded grasps."""

from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Literal

import typer

from cell.config.model import CellConfig
from cell.control.identification import Identification, ReadShape
from cell.errors import ConfigError
from cell.interfaces.cli import options
from cell.interfaces.cli.session import (
    cell_config,
    model_of_folder,
    pads_of,
    release_command,
    running_cell,
)
from cell.interfaces.cli.terminal import percent, show
from cell.learning.model import load_model
from cell.learning.shape_reading import NO_SHAPE, after_label, shape_reader
from cell.learning.training import identify_recorded
from cell.recording.dataset import read_grasps
from cell.runtime.goals import IdentifyGoal, checked_goal
from cell.runtime.tasks import drawn_object
from recognition.drift.drift import drift_text
from recognition.recognizer import UNKNOWN
from recognition.statistics.fusion import fuse


def identify(
    dataset: options.Grasps = None,
    model: options.FolderModel = None,
    held: Annotated[
        str | None, typer.Option("--object", help="Object in the simulated cell.")
    ] = None,
    follow: Annotated[
        bool, typer.Option("--follow", help="With DATASET: follow the drift of the sensors.")
    ] = False,
    keep: Annotated[
        Literal["never", "when-named", "always"],
        typer.Option("--keep", help="When to keep the part in the grip after the answer."),
    ] = "never",
    config: options.Config = None,
    out_folder: options.Out = None,
    seed: options.Seed = None,
    faults: options.Faults = None,
    json_file: options.Json = None,
) -> None:
    """Grasp a part and name it, or name recorded grasps; with shape and size."""
    if (model := model_of_folder(model)) is None:
        raise ConfigError("--model is missing; `tactile-cell model train` makes one")
    checked = cell_config(config, seed=seed, faults=faults)
    if dataset is not None:
        if faults:
            raise ConfigError("--fault is for the simulated cell: leave it out for recorded grasps")
        if keep != "never":
            raise ConfigError("--keep is for a cell: leave it out for recorded grasps")
        read_shape = shape_reader(checked)
        _identify_recorded(checked, model, dataset, read_shape, follow=follow, json_file=json_file)
        return
    if follow:
        raise ConfigError("--follow is for recorded grasps: leave it out, or name DATASET")
    load_model(model, pads_of(checked))
    goal = checked_goal(
        {
            "task": IdentifyGoal.task,
            "seed": checked.seed + 1,
            "present": drawn_object(checked) if held is None else held,
            "keep": keep.replace("-", "_"),
        }
    )
    trials: list[Identification] = []
    with running_cell(
        *(checked, "identify", out_folder), config_file=config, json_file=json_file, model=model
    ) as cell:
        cell.plugin.watch_parts(lambda _, named: trials.append(named) if named else None)
        part = cell.run(goal)
    (identification,) = trials
    lines: list[str] = []
    for number, (record, posterior, shape) in enumerate(
        zip_longest(identification.records, identification.posteriors, identification.shapes),
        start=1,
    ):
        alone = fuse([posterior])
        no_shape = "no shape" if record.outcome.unreached else NO_SHAPE
        lines.append(
            f"grasp {number}: {alone.name} {percent(alone.name_probability)}"
            + (f" (nearest: {alone.best})" if alone.name == UNKNOWN else "")
            + (f"; {shape or no_shape}" if identification.shapes else "")
            + (f"; {record.ended}" if record.ended else "")
        )
    was = f" (it was {part.presented})" if part.presented else ""
    if part.remark not in ("", *(record.ended for record in identification.records)):
        lines.append(part.remark)
    shape_text = after_label(part.label, part.shape)
    lines.append(
        f"answer: {part.label} {percent(identification.fused.name_probability)}{shape_text}{was}"
    )
    if part.in_grip and config is not None and not checked.simulated:
        lines.append(f"the part is kept; to release it: {release_command(config)}")
    elif part.in_grip:
        lines.append("the part was kept until the simulated cell ended with this command")
    values = {
        "probabilities": part.probabilities,
        "shapes": [shape and shape.as_dict() for shape in identification.shapes],
        "ramps": [record.ramp_as_json() for record in identification.records],
        "drift": part.drift and part.drift.values,
    }
    cell.finish(lines, part.model_dump() | values)


def _identify_recorded(
    config: CellConfig,
    model: Path,
    dataset: Path,
    read_shape: ReadShape | None,
    *,
    follow: bool,
    json_file: Path | None,
) -> None:

    loaded = load_model(model).with_caution(config.recognition.caution)
    recorded = read_grasps(dataset)
    answers = identify_recorded(loaded, recorded, follow=follow, read_shape=read_shape)
    lines, rows = list[str](), []
    for number, (grasp, answer) in enumerate(zip(recorded, answers, strict=True)):
        posterior, shape, drift = answer
        probability = posterior.name_probability
        lines.append(
            f"grasp {number:4d}: {posterior.name:<24} {percent(probability)}"
            + ("" if read_shape is None else f"   {shape or NO_SHAPE}")
            + (f"   (was {grasp.label})" if grasp.label else "")
        )
        values = {
            "grasp": number,
            "label": posterior.name,
            "probability": probability,
            "unknown": posterior.unknown,
            "truth": grasp.label or None,
            "shape": shape and shape.as_dict(),
        }
        rows.append(values if drift is None else values | {"drift": drift.values})
    _, (*_, last) = max(zip(recorded, answers, strict=True), key=lambda pair: pair[0].start_ms)
    if last is not None and last.likely:
        lines.append(f"the sensors have drifted since teaching: {drift_text(last.drift)}")
    show(lines, {"answers": rows}, json_file)
