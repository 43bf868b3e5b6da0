"""The command that names objects: identify, on the cell or of recorded grasps."""

from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

import typer

from cell.choosing import memory_for
from cell.cli.drawings import GaugeOption, GaugeShapeOption
from cell.cli.options import (
    ConfigOption,
    FaultOption,
    JsonOption,
    ModelOption,
    OutOption,
    SeedOption,
)
from cell.cli.output import percent, progress_bar, say, write_json
from cell.cli.running import faulted, pads_of, running_cell, seeded
from cell.config import CellConfig
from cell.config_file import load_config
from cell.dataset import read_dataset
from cell.early_heads import loaded_heads
from cell.errors import ConfigError, ModelError
from cell.jobs.files import job_folder
from cell.jobs.identifying import identify_on_cell, identify_recorded
from cell.model import load_model
from cell.pad_knowledge import pad_knowledge
from cell.shapes import NO_SHAPE, ReadShape, beside, shape_reader
from cell.shift import Shift, drift_text, drift_values
from recognition.shape_answer import ShapeAnswer


def identify(
    dataset: Annotated[
        Path | None, typer.Argument(help="Recorded grasps; without them, the cell grasps.")
    ] = None,
    model: ModelOption = None,
    held: Annotated[
        str | None, typer.Option("--object", help="Object that the simulated cell shall hold.")
    ] = None,
    follow: Annotated[
        bool,
        typer.Option(
            "--follow", help="Follow the drift of the sensors through the recorded grasps."
        ),
    ] = False,
    gauge: GaugeOption = None,
    gauge_shape: GaugeShapeOption = None,
    config: ConfigOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    faults: FaultOption = None,
    json_file: JsonOption = None,
) -> None:
    """Name the object in the grip, or the objects of recorded grasps; say shape and size."""
    if model is None:
        raise ConfigError("--model is missing; `tactile-cell train` makes one")
    checked = faulted(seeded(load_config(config), seed), faults)
    read_shape = shape_reader(checked, pad_knowledge(checked, gauge, gauge_shape))
    if dataset is not None:
        if faults:
            raise ConfigError(
                "--fault is for the simulated cell; recorded grasps are what they are"
            )
        _identify_recorded(model, dataset, read_shape, follow=follow, json_file=json_file)
        return
    if follow:
        raise ConfigError("--follow is for recorded grasps; a cell that grasps one object has none")
    folder = out_folder or Path(checked.recording.directory)
    _identify_held(checked, model, held, folder, read_shape, json_file=json_file)


def _identify_recorded(
    model: Path,
    dataset: Path,
    read_shape: ReadShape | None,
    *,
    follow: bool,
    json_file: Path | None,
) -> None:
    loaded = load_model(model)
    recorded = read_dataset(dataset)
    shift = Shift(loaded.recognizer)
    if follow and not shift.follows:
        raise ModelError(
            f"a model of {loaded.trainer_name} cannot follow a drift; train one of force_ramp"
        )
    answers = identify_recorded(loaded, recorded, shift=shift if follow else None)
    shapes = [None if read_shape is None else read_shape(grasp) for grasp in recorded]
    for answer, shape in zip(answers, shapes, strict=True):
        say(
            f"grasp {answer.number:4d}: {answer.label:<24} {percent(answer.probability)}"
            + ("" if read_shape is None else f"   {shape or NO_SHAPE}")
            + (f"   (was {answer.truth})" if answer.truth else "")
        )
    if shift.belief is not None and shift.belief.likely:
        say(
            f"the sensors have drifted: {drift_text(shift.drift)}; `tactile-cell calibrate "
            f"{dataset} --model {model} -o NEW` takes it off where most objects were taught"
        )
    both = zip(answers, shapes, strict=True)
    write_json(
        json_file,
        {"answers": [answer.as_json() | {"shape": _plain(shape)} for answer, shape in both]},
    )


def _identify_held(
    config: CellConfig,
    model: Path,
    held: str | None,
    folder: Path,
    read_shape: ReadShape | None,
    *,
    json_file: Path | None,
) -> None:
    loaded = load_model(model, pads_of(config))
    # What the model lacks is said before any hardware is touched.
    loaded_heads(loaded, config.sequence)
    memory_for(config.sequence, loaded)
    folder = job_folder(folder, "identify")
    with running_cell(config, folder, json_file=json_file) as cell, progress_bar() as progress:
        found, truth = identify_on_cell(
            cell, config, loaded, held=held, progress=progress, read_shape=read_shape
        )
        recording = cell.recording_path
    for number, (record, posterior, shape) in enumerate(
        zip_longest(found.records, found.posteriors, found.shapes), start=1
    ):
        say(
            f"grasp {number}: {posterior.best} {percent(float(posterior.probability.max()))}, "
            f"untaught {percent(posterior.unknown)}"
            + (f"; {shape or NO_SHAPE}" if found.shapes else "")
            + (f"; {record.ended}" if record.ended else "")
        )
    was = f" (it was {truth})" if truth else ""
    felt = beside(found.label, found.shape)
    say(f"answer: {found.label} {percent(found.probability)}{felt}{was}")
    write_json(
        json_file,
        {
            "label": found.label,
            "probability": found.probability,
            "probabilities": dict(
                zip(found.fused.labels, found.fused.probability.tolist(), strict=True)
            ),
            "unknown": found.fused.unknown,
            "n_grasps": len(found.posteriors),
            "shape": _plain(found.shape),
            "shapes": [_plain(shape) for shape in found.shapes],
            "ramps": [record.ramp_as_json() for record in found.records],
            "drift": None if found.drift is None else drift_values(found.drift),
            "held": truth,
            "recording": str(recording),
        },
    )


def _plain(shape: ShapeAnswer | None) -> dict[str, Any] | None:
    return None if shape is None else shape.as_dict()
