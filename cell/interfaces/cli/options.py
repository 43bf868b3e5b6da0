"""Options that several commands share. Imports stay light: help and completion load this file."""

from pathlib import Path
from typing import Annotated

import typer

from cell.errors import ConfigError, raised_as
from cell.plugins import RECOGNIZERS


def in_a_folder(path: Path | None) -> Path | None:
    """Refuse a file to write without a folder: at the end the work would be lost."""
    if path is not None and not path.parent.is_dir():
        raise typer.BadParameter(f"{path}: the folder {path.parent} does not exist; make it first")
    return path


def _ending(suffix: str, what: str) -> typer.models.OptionInfo:
    """Return the option ``--output`` of a file whose name must end with ``suffix``."""

    def checked(path: Path | None) -> Path | None:
        if path is not None and path.suffix != suffix:
            raise typer.BadParameter(f"{path}: the name of a {what} ends in {suffix}")
        return in_a_folder(path)

    option: typer.models.OptionInfo = typer.Option(
        "--output", "-o", help=f"{what.capitalize()} to write ({suffix}).", callback=checked
    )
    return option


FOLDER_CONFIG = Path("tactile-cell.yaml")
"""Config file that is used if it is in the current folder and no other file is named."""


def or_of_folder(path: Path | None) -> Path | None:
    """Return the named config file, else that of this folder; None if there is none."""
    there = FOLDER_CONFIG.exists() or FOLDER_CONFIG.is_symlink()
    return FOLDER_CONFIG if path is None and there else path


Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        "-c",
        help=f"Config file of the cell [default: {FOLDER_CONFIG} in this folder, else the "
        "built-in simulated cell].",
        callback=or_of_folder,
    ),
]


def _json_file(path: Path | None) -> Path | None:
    """Refuse a name of another kind: the file may exist."""
    if path is not None and path.suffix != ".json":
        raise typer.BadParameter(f"{path}: the name must end with .json")
    return path


Json = Annotated[
    Path | None, typer.Option("--json", callback=_json_file, help="Also write the result as JSON.")
]
Out = Annotated[
    Path | None,
    typer.Option(
        "--out",
        help="Folder for recordings and reports [default: the config key recording.directory].",
    ),
]
MAX_SEED = 2**32 - 1
"""Largest seed, as in the config."""
Seed = Annotated[
    int | None,
    typer.Option(
        "--seed", help="Seed [default: that of the config].", min=0, max=MAX_SEED, metavar="N"
    ),
]
Model = Annotated[Path | None, typer.Option("--model", "-m", help="File of a taught model.")]
FolderModel = Annotated[
    Path | None,
    typer.Option(
        "--model", "-m", help="Taught model [default: that of the last `model train` here]."
    ),
]
ModelOut = Annotated[Path, _ending(".npz", "model file")]
DatasetOut = Annotated[Path, _ending(".npz", "data set")]
RecordingOut = Annotated[Path | None, _ending(".mcap", "recording")]
Grasps = Annotated[
    Path | None, typer.Argument(help="Recorded grasps; without them the cell grasps.")
]
Faults = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="FAULT",
        help="Fault of the simulated cell, for example can.loss=0.05@2s; repeat for several "
        "(simulate --list-faults).",
    ),
]
Cells = Annotated[
    list[str] | None,
    typer.Option("--cell", metavar="NAME", help="Only grasps of this cell; repeat for several."),
]
Days = Annotated[
    str | None,
    typer.Option("--days", help="Only grasps of a day, as 2027-01-15, or of FIRST..LAST (UTC)."),
]
Objects = Annotated[
    list[str] | None,
    typer.Option("--object", metavar="NAME", help="Only grasps of this object; repeat for more."),
]


def taught_grasps(purpose: str) -> typer.models.OptionInfo:
    """Return the option for the number of taught grasps of each object; ``purpose``: its help."""
    option: typer.models.OptionInfo = typer.Option(
        "--teach", min=3, max=1000, metavar="N", help=purpose
    )
    return option


def known_recognizers(names: list[str] | None) -> list[str] | None:
    """Return the names of recognizers. Raises typer.BadParameter for an unknown name."""
    for name in names or ():
        with raised_as(typer.BadParameter, ConfigError):
            RECOGNIZERS.entry(name)
    return names


Recognizer = Annotated[
    str,
    typer.Option(
        "--recognizer",
        help="Kind of recognizer; `doctor --plugins` lists them.",
        callback=lambda name: known_recognizers([name]) and name,
    ),
]
