"""The command that takes the drift of the sensors off a model: calibrate."""

from pathlib import Path
from typing import Annotated

import typer

from cell.cli.options import ConfigOption, JsonOption, ModelOption, OutOption, SeedOption
from cell.cli.output import progress_bar, say, write_json
from cell.cli.running import pads_of, running_cell, seeded
from cell.config_file import load_config
from cell.dataset import read_dataset
from cell.errors import CellError, ConfigError
from cell.jobs.calibrating import GAUGE_GRASPS, calibrate_model, follow_shift
from cell.jobs.files import job_folder
from cell.jobs.teaching import teach as teach_object
from cell.model import LoadedModel, load_model, save_model
from recognition.grasp import Grasp


def calibrate(
    output: Annotated[Path, typer.Option("--output", "-o", help="Corrected model to write.")],
    dataset: Annotated[
        Path | None, typer.Argument(help="Recorded grasps; without them, the cell grasps.")
    ] = None,
    gauge: Annotated[
        str | None,
        typer.Option(
            "--gauge",
            help="The known object: one that was taught. Without it DATASET holds any grasps of a "
            "shift, most of them of taught objects.",
        ),
    ] = None,
    model: ModelOption = None,
    grasps: Annotated[int, typer.Option("--grasps", "-n", min=1, max=100)] = GAUGE_GRASPS,
    config: ConfigOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    json_file: JsonOption = None,
) -> None:
    """Correct a model for drift since teaching, by a known object or by any grasps of a shift."""
    if model is None:
        raise ConfigError("--model is missing; `tactile-cell train` makes one")
    if gauge is None:
        if dataset is None:
            raise ConfigError("name the gauge object with --gauge, or give the grasps of a shift")
        _by_shift(load_model(model), dataset, output, json_file)
        return
    if dataset is not None:
        loaded = load_model(model)
        taken = _grasps_of(gauge, dataset)
    else:
        checked = seeded(load_config(config), seed)
        loaded = load_model(model, pads_of(checked))
        folder = job_folder(out_folder or Path(checked.recording.directory), "calibrate")
        with running_cell(checked, folder) as cell, progress_bar() as progress:
            records = teach_object(
                cell, checked, gauge, grasps, seed=checked.seed, progress=progress
            )
        taken = [record.grasp for record in records]
    corrected, found = calibrate_model(loaded, gauge, taken)
    save_model(
        output,
        corrected,
        trainer_name=loaded.trainer_name,
        pads=loaded.pads,
        sections=loaded.sections,
    )
    gain, offset_mm = found.drift.gain, found.drift.aperture_offset_m * 1e3
    say(
        f"{found.n_grasps} grasps of {gauge}: gain {gain:.2f} (+-{100 * found.log_gain_sd:.0f} %), "
        f"opening {offset_mm:+.1f} mm (+-{found.offset_sd_m * 1e3:.1f}): {output}"
    )
    write_json(
        json_file,
        {
            "model": str(output),
            "gauge": gauge,
            "n_grasps": found.n_grasps,
            "gain": gain,
            "aperture_mm": offset_mm,
            "log_gain_sd": found.log_gain_sd,
            "aperture_sd_mm": found.offset_sd_m * 1e3,
        },
    )


def _grasps_of(gauge: str, dataset: Path) -> list[Grasp]:
    """Return the gauge's grasps of a data set: those of its label, and those without one."""
    grasps = read_dataset(dataset)
    taken = [grasp for grasp in grasps if grasp.label in {gauge, ""}]
    if not taken:
        labels = ", ".join(sorted({repr(grasp.label) for grasp in grasps}))
        raise CellError(
            f"{dataset}: none of its {len(grasps)} grasps is of {gauge!r}, there are {labels}; "
            "name the gauge as it is called there"
        )
    return taken


def _by_shift(loaded: LoadedModel, dataset: Path, output: Path, json_file: Path | None) -> None:
    taken = read_dataset(dataset)
    corrected, drift = follow_shift(loaded, taken)
    save_model(
        output,
        corrected,
        trainer_name=loaded.trainer_name,
        pads=loaded.pads,
        sections=loaded.sections,
    )
    offset_mm = drift.aperture_offset_m * 1e3
    say(
        f"{len(taken)} grasps of a shift: gain {drift.gain:.2f}, opening {offset_mm:+.1f} mm: "
        f"{output}"
    )
    write_json(
        json_file,
        {
            "model": str(output),
            "gauge": None,
            "n_grasps": len(taken),
            "gain": drift.gain,
            "aperture_mm": offset_mm,
        },
    )
