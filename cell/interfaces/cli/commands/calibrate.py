"""`calibrate`: corrects a model for the drift of the sensors since it was taught."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cell.interfaces.cli.options import (
    ConfigOption,
    GraspsArgument,
    JsonOption,
    ModelOption,
    ModelOutOption,
    OutOption,
    SeedOption,
)

if TYPE_CHECKING:
    from cell.learning.model import LoadedModel
    from recognition.drift.drift import Drift
    from recognition.grasp import Grasp
    from recognition.recognizer import Recognizer


def calibrate(
    output: ModelOutOption,
    dataset: GraspsArgument = None,
    gauge: Annotated[
        str | None,
        typer.Option(
            "--gauge",
            help="The known object: one that was taught. Without it DATASET holds any grasps of a "
            "shift, most of them of taught objects.",
        ),
    ] = None,
    model: ModelOption = None,
    grasps: Annotated[
        int, typer.Option("--grasps", "-n", min=1, max=100, help="Grasps of the gauge object.")
    ] = 3,
    config: ConfigOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    json_file: JsonOption = None,
) -> None:
    """Correct a model for the drift of the sensors since teaching.

    By a known object, or by any grasps of a shift.
    """
    from cell.data.dataset import read_grasps
    from cell.errors import ConfigError
    from cell.interfaces.cli.session import cell_config, pads_of, running_cell
    from cell.interfaces.cli.terminal import print_line, progress_bar
    from cell.jobs.calibrate import calibrate_model, check_gauge, follow_shift
    from cell.jobs.common import job_folder
    from cell.jobs.teach import teach as teach_object
    from cell.learning.model import load_model
    from recognition.drift.drift import drift_text

    if model is None:
        raise ConfigError("--model is missing; `tactile-cell train` makes one")
    if gauge is None:
        if dataset is None:
            raise ConfigError("name the gauge object with --gauge, or give the grasps of a shift")
        loaded = load_model(model)
        taken = list(read_grasps(dataset))
        corrected, drift = follow_shift(loaded, taken)
        _write(output, corrected, loaded, None, len(taken), drift, json_file)
        print_line(f"{len(taken)} grasps of a shift: {drift_text(drift)}: {output}")
        return
    if dataset is not None:
        loaded = load_model(model)
        taken = _grasps_of(gauge, dataset)
    else:
        checked = cell_config(config, seed=seed)
        loaded = load_model(model, pads_of(checked))
        check_gauge(loaded, gauge)
        folder = job_folder(out_folder or Path(checked.recording.directory), "calibrate")
        with (
            running_cell(checked, folder, json_file=json_file, config_file=config) as cell,
            progress_bar() as progress,
        ):
            records = teach_object(
                cell, checked, gauge, grasps, seed=checked.seed, progress=progress
            )
        taken = [record.grasp for record in records]
    corrected, found = calibrate_model(loaded, gauge, taken)
    _write(
        output,
        corrected,
        loaded,
        gauge,
        len(taken),
        found.drift,
        json_file,
        log_gain_sd=found.log_gain_sd,
        aperture_sd_mm=found.offset_sd_m * 1e3,
    )
    print_line(
        f"{len(taken)} grasps of {gauge}: {drift_text(found.drift)} "
        f"(+-{100 * found.log_gain_sd:.0f} %, +-{found.offset_sd_m * 1e3:.1f} mm): {output}"
    )


def _grasps_of(gauge: str, dataset: Path) -> "list[Grasp]":
    """Return the gauge's grasps of a data set: those of its label, and those without one."""
    from cell.data.dataset import read_grasps
    from cell.errors import CellError

    grasps = read_grasps(dataset)
    taken = [grasp for grasp in grasps if grasp.label in {gauge, ""}]
    if not taken:
        labels = ", ".join(sorted({repr(grasp.label) for grasp in grasps}))
        raise CellError(
            f"{dataset}: none of its {len(grasps)} grasps is of {gauge!r}, there are {labels}; "
            "name the gauge as it is called there"
        )
    return taken


def _write(
    output: Path,
    corrected: "Recognizer",
    loaded: "LoadedModel",
    gauge: str | None,
    n_grasps: int,
    drift: "Drift",
    json_file: Path | None,
    **spread: Any,
) -> None:
    from cell.interfaces.cli.terminal import write_json
    from cell.learning.model import save_model
    from recognition.drift.drift import drift_values

    save_model(
        output,
        corrected,
        trainer_name=loaded.trainer_name,
        pads=loaded.pads,
        sections=loaded.sections,
    )
    write_json(
        json_file,
        {
            "model": str(output),
            "gauge": gauge,
            "n_grasps": n_grasps,
            **drift_values(drift),
            **spread,
        },
    )
