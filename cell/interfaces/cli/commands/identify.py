"""`identify`: names the object in the grip, or the objects of recorded grasps."""

from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from cell.interfaces.cli.options import (
    ConfigOption,
    FaultOption,
    GaugeOption,
    GaugeShapeOption,
    GraspsArgument,
    JsonOption,
    ModelOption,
    OutOption,
    SeedOption,
)

if TYPE_CHECKING:
    from cell.config.model import CellConfig
    from cell.control.identification import ReadShape
    from cell.plugin.part_report import PartReport
    from recognition.shape.answer import ShapeAnswer


def identify(
    dataset: GraspsArgument = None,
    model: ModelOption = None,
    held: Annotated[
        str | None, typer.Option("--object", help="Object in the simulated cell.")
    ] = None,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow", help="Correct the drift of the sensors through the recorded grasps."
        ),
    ] = False,
    keep: Annotated[
        Literal["never", "when-named", "always"],
        typer.Option("--keep", help="When to keep the part in the grip after the answer."),
    ] = "never",
    gauge: GaugeOption = None,
    gauge_shape: GaugeShapeOption = None,
    config: ConfigOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    faults: FaultOption = None,
    json_file: JsonOption = None,
) -> None:
    """Identify the part in the grip, or the parts of recorded grasps; with shape and size."""
    from cell.errors import ConfigError
    from cell.interfaces.cli.session import cell_config, pads_of, release_command, running_cell
    from cell.interfaces.cli.terminal import percent, print_line, write_json
    from cell.jobs.identify import drawn_object
    from cell.learning.model import load_model
    from cell.learning.pad_knowledge import pad_knowledge
    from cell.learning.shape_reading import NO_SHAPE, beside, shape_reader
    from cell.plugin.goals import IdentifyGoal
    from recognition.recognizer import UNKNOWN
    from recognition.statistics.fusion import fuse

    if model is None:
        raise ConfigError("--model is missing; `tactile-cell train` makes one")
    checked = cell_config(config, seed=seed, faults=faults)
    if dataset is not None:
        if faults:
            raise ConfigError("--fault is for the simulated cell: leave it out for recorded grasps")
        if keep != "never":
            raise ConfigError("--keep is for a cell: leave it out for recorded grasps")
        read_shape = shape_reader(checked, pad_knowledge(checked, gauge, gauge_shape))
        _identify_recorded(checked, model, dataset, read_shape, follow=follow, json_file=json_file)
        return
    if follow:
        raise ConfigError("--follow is for recorded grasps: leave it out, or name DATASET")
    load_model(model, pads_of(checked))
    goal = IdentifyGoal(
        seed=checked.seed + 1,
        present=drawn_object(checked) if held is None else held,
        keep=keep.replace("-", "_"),  # type: ignore[arg-type]
    )
    parts: list[PartReport] = []
    with running_cell(
        *(checked, "identify", out_folder),
        config_file=config,
        json_file=json_file,
        model=model,
        gauge=gauge,
        gauge_shape=gauge_shape,
    ) as cell:
        cell.plugin.watch_parts(parts.append)
        cell.run(goal)
    found, truth = parts[0].found, goal.present
    assert found is not None
    for number, (record, posterior, shape) in enumerate(
        zip_longest(found.records, found.posteriors, found.shapes), start=1
    ):
        alone = fuse([posterior])
        print_line(
            f"grasp {number}: {alone.name} {percent(alone.name_probability)}"
            + (f" (nearest: {alone.best})" if alone.name == UNKNOWN else "")
            + (f"; {shape or NO_SHAPE}" if found.shapes else "")
            + (f"; {record.ended}" if record.ended else "")
        )
    was = f" (it was {truth})" if truth else ""
    if found.remark:
        print_line(found.remark)
    felt = beside(found.label, found.shape)
    print_line(f"answer: {found.label} {percent(found.fused.name_probability)}{felt}{was}")
    if found.kept and config is not None and not checked.simulated:
        print_line(f"the part is kept; to release it: {release_command(config)}")
    elif found.kept:
        print_line("the part was kept until the simulated cell ended with this command")
    write_json(
        json_file,
        {
            "label": found.label,
            "probability": found.probability,
            "probabilities": found.probabilities,
            "unknown": found.fused.unknown,
            "n_grasps": len(found.posteriors),
            "kept": found.kept,
            "shape": _plain(found.shape),
            "shapes": [_plain(shape) for shape in found.shapes],
            "ramps": [record.ramp_as_json() for record in found.records],
            "drift": None if found.drift is None else found.drift.values,
            "held": truth,
        }
        | cell.made,
    )
    cell.plugin.check_recording()


def _identify_recorded(
    config: "CellConfig",
    model: Path,
    dataset: Path,
    read_shape: "ReadShape | None",
    *,
    follow: bool,
    json_file: Path | None,
) -> None:
    from cell.data.dataset import read_grasps
    from cell.interfaces.cli.terminal import percent, print_line, write_json
    from cell.jobs.identify import identify_recorded
    from cell.learning.model import load_model
    from cell.learning.shape_reading import NO_SHAPE
    from cell.learning.training import loaded
    from recognition.drift.drift import drift_text

    found, recorded = load_model(model), read_grasps(dataset)
    found = replace(found, recognizer=loaded(found, config).recognizer)
    answers = identify_recorded(found, recorded, follow=follow, read_shape=read_shape)
    for answer in answers:
        print_line(
            f"grasp {answer.number:4d}: {answer.label:<24} {percent(answer.probability)}"
            + ("" if read_shape is None else f"   {answer.shape or NO_SHAPE}")
            + (f"   (was {answer.truth})" if answer.truth else "")
        )
    last = max(answers, key=lambda answer: recorded[answer.number].start_ms).drift
    if last is not None and last.likely:
        print_line(f"the sensors have drifted since teaching: {drift_text(last.drift)}")
    write_json(json_file, {"answers": [answer.as_json() for answer in answers]})


def _plain(shape: "ShapeAnswer | None") -> dict[str, Any] | None:
    return None if shape is None else shape.as_dict()
