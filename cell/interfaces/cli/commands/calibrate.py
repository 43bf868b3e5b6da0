"""`model calibrate`: corrects a model for the drift of the sensors since it was taught."""

from pathlib import Path
from typing import Annotated

import typer

from cell.data.dataset import read_grasps
from cell.errors import CellError, ConfigError
from cell.interfaces.cli.options import (
    ConfigOption,
    GraspsArgument,
    JsonOption,
    ModelOption,
    ModelOutOption,
    OutOption,
    SeedOption,
)
from cell.interfaces.cli.session import RunningCell, cell_config, pads_of, running_cell
from cell.interfaces.cli.terminal import show
from cell.learning.model import load_model, save_model
from cell.learning.training import calibrate_model, follow_shift, gaugeable
from cell.runtime.goals import TeachGoal
from recognition.drift.drift import drift_text
from recognition.grasp import Grasp


def calibrate(
    output: ModelOutOption,
    dataset: GraspsArgument = None,
    gauge: Annotated[
        list[str] | None,
        typer.Option(
            "--gauge",
            help="A taught object; repeat for several: two give a better result than one. "
            "Without it, DATASET holds any grasps of a shift.",
        ),
    ] = None,
    model: ModelOption = None,
    grasps: Annotated[
        int, typer.Option("--grasps", "-n", min=1, max=100, help="Grasps of each gauge object.")
    ] = 3,
    config: ConfigOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    json_file: JsonOption = None,
) -> None:
    """Correct a model for the drift of the sensors since teaching.

    Uses known objects, or any grasps of a shift.
    """
    if model is None:
        raise ConfigError("--model is missing; `tactile-cell model train` makes one")
    taken: dict[str, list[Grasp]] = {}
    cell: RunningCell | None = None
    if dataset is not None:
        loaded = load_model(model)
        found = list(read_grasps(dataset))
        taken = {
            label: _grasps_of(label, found, dataset, alone=len(gauge or ()) == 1)
            for label in gauge or ()
        }
        corrected = calibrate_model(loaded, taken) if gauge else follow_shift(loaded, found)
        n_grasps = sum(map(len, taken.values())) if gauge else len(found)
    elif not gauge:
        raise ConfigError("the object is missing: add --gauge NAME, or name grasps of a shift")
    else:
        checked = cell_config(config, seed=seed)
        loaded = load_model(model, pads_of(checked))
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
    save_model(
        output,
        corrected,
        trainer_name=loaded.trainer_name,
        pads=loaded.pads,
        sections=loaded.sections,
    )
    values = {"model": output, "gauge": gauge, **corrected.grid.values, "n_grasps": n_grasps}
    line = (
        f"{n_grasps} grasps of {' and '.join(gauge) if gauge else 'a shift'}: "
        f"{drift_text(corrected.grid.drift)} (+-{1e3 * corrected.grid.offset_sd_m:.1f} mm): "
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
            f"{dataset}: its {len(grasps)} grasps have no {gauge!r}, but {labels}; use one of "
            "these names for --gauge"
        )
    return taken
