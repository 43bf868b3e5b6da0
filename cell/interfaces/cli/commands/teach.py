"""`teach`: grasps a known object, or its drawing, and adds the grasps to a data set."""

from pathlib import Path
from typing import Annotated, Any

import typer

from cell.config.model import CellConfig
from cell.errors import CellError, ConfigError, DatasetError, raised_as
from cell.files import check_text, checked_label
from cell.interfaces.cli import options
from cell.interfaces.cli.session import cell_config, pads_of, running_cell
from cell.interfaces.cli.terminal import print_line, progress_bar, show
from cell.learning.drawing import teach_drawing
from cell.learning.labelled_grasps import append_to_dataset, dataset_to_extend, name_recorded
from cell.runtime.goals import TAUGHT_GRASPS, TeachGoal, checked_goal
from cell.simulation import drawn_shape

_VIRTUAL_GRASPS = 60
"""Default number of virtual grasps of a drawing."""

_SEED_OF_DRAWINGS = 1_000_003
"""Offset of the seed: poses and noise of virtual grasps must differ from those of real grasps."""


def teach(
    label: Annotated[str, typer.Argument(help="Name of the object.")],
    dataset: options.DatasetOut,
    grasps: Annotated[
        int | None,
        typer.Option(
            "--grasps",
            "-n",
            min=1,
            max=1000,
            metavar="N",
            help=f"Number of grasps [default: {TAUGHT_GRASPS}, of a drawing {_VIRTUAL_GRASPS}].",
        ),
    ] = None,
    shape: Annotated[
        str | None,
        typer.Option(
            "--shape",
            help="Teach from a shape without grasping: cylinder:diameter=6mm,length=20mm, or "
            "mesh:file=part.stl, an STL file in mm.",
        ),
    ] = None,
    recorded: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Use the unlabelled grasps of this recording or data set instead of new ones.",
        ),
    ] = None,
    series: Annotated[
        str,
        typer.Option(
            "--series",
            help="Name of the individual or of the day [default: a pause of an hour begins a new "
            "series].",
        ),
    ] = "",
    present: Annotated[
        str | None, typer.Option("--object", help="Simulated object [default: that label].")
    ] = None,
    config: options.Config = None,
    out_folder: options.Out = None,
    seed: options.Seed = None,
    faults: options.Faults = None,
    json_file: options.Json = None,
) -> None:
    """Grasp a known object, or a drawing of it, for a data set."""
    with raised_as(ConfigError, ValueError):
        label = checked_label(label)
        check_text("series", series)
    if recorded is not None:
        added, before = name_recorded(recorded, label, dataset, series)
        line = f"{added} grasps of {recorded} added to {dataset} as {label} ({before} before)"
        values = {"label": label, "n_grasps": added, "dataset": dataset, "source": recorded}
        show([line], values, json_file)
        return
    checked = cell_config(config, seed=seed, faults=faults)
    if shape is None:
        count = grasps or TAUGHT_GRASPS
        fields = {"label": label, "grasps": count, "present": present, "train": False}
        goal = checked_goal({"task": TeachGoal.task} | fields)
        assert isinstance(goal, TeachGoal)
        _teach_grasps(checked, config, goal, dataset, series, out_folder, json_file)
        return
    if series:
        raise ConfigError("--series is for grasps: leave it out for a drawing")
    if faults:
        raise ConfigError("--fault is for the simulated cell: leave it out for a drawing")
    _teach_drawing(checked, label, dataset, grasps or _VIRTUAL_GRASPS, shape, json_file=json_file)


def _teach_grasps(
    config: CellConfig,
    config_file: Path | None,
    goal: TeachGoal,
    dataset: Path,
    series: str,
    out_folder: Path | None,
    json_file: Path | None,
) -> None:
    objects, named = [entry.label for entry in config.simulator.objects], goal.present or goal.label
    if config.brings_objects and ":" not in named and named not in objects:
        raise ConfigError(
            f"{named!r:.60} is no object of the simulated cell: `--object NAME` places one of "
            f"{', '.join(objects)}, and the label stays"
        )
    before = dataset_to_extend(dataset, pads_of(config))
    goal = goal.model_copy(update={"seed": config.seed + len(before)})
    taught: dict[str, Any] = {}
    with running_cell(
        *(config, "teach", out_folder), config_file=config_file, json_file=json_file
    ) as cell:
        try:
            cell.run(goal, lambda job: taught.update(job.progress))
        finally:
            if taken := cell.plugin.model.training_set:
                try:
                    n_before = append_to_dataset(dataset, taken, series)
                except CellError as error:
                    recording = cell.plugin.recording_path
                    step = f"they are in {recording}: use it with `tactile-cell model train`"
                    if cell.plugin.cell.recording_fault:
                        step = f"{recording} has stopped, too: free space, and teach again"
                    raise DatasetError(
                        f"{error}; grasps that are not saved: {len(taken)}; {step}"
                    ) from error
                missed = f" ({taught['missed']} found no part)" if taught["missed"] else ""
                print_line(
                    f"{len(taken)} of {goal.grasps} grasps of {goal.label}{missed} added to "
                    f"{dataset} ({n_before} before)"
                )
                if taught["unreached"]:
                    print_line(taught["unreached"])
    values = {"label": goal.label, "n_grasps": taught["grasps"], "n_missed": taught["missed"]}
    cell.finish([f"recording: {cell.plugin.recording_path}"], values | {"dataset": dataset})


def _teach_drawing(
    config: CellConfig,
    label: str,
    dataset: Path,
    n_grasps: int,
    drawing: str,
    *,
    json_file: Path | None,
) -> None:
    shape = drawn_shape(drawing)
    before = dataset_to_extend(dataset, pads_of(config))
    with progress_bar() as progress:
        grasps = teach_drawing(
            config,
            label,
            shape,
            n_grasps,
            kind=drawing.partition(":")[0],
            seed=_SEED_OF_DRAWINGS + config.seed + len(before),
            start_ms=max((grasp.start_ms + 1000 for grasp in before), default=0),
            progress=progress,
        )
    n_before = append_to_dataset(dataset, grasps)
    lines = [
        f"{len(grasps)} virtual grasps of {label} added to {dataset} ({n_before} before)",
        f"noise of the config (simulator.noise_level: {config.simulator.noise_level:g}); if the "
        "sensor has more, taught objects become unknown",
    ]
    values = {"label": label, "n_grasps": len(grasps), "dataset": dataset, "source": "drawing"}
    show(lines, values | {"drawing": drawing}, json_file)
