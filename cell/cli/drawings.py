"""What `teach --shape` does."""

from pathlib import Path
from typing import Annotated

import typer

from cell.cli.output import progress_bar, say, write_json
from cell.config import CellConfig
from cell.dataset import read_dataset
from cell.errors import ConfigError
from cell.jobs.drawing import teach_drawing
from cell.jobs.teaching import append_to_dataset
from cell.pad_knowledge import pad_knowledge
from cell.simulation import drawn_shape

DEFAULT_GRASPS = 60
"""Virtual grasps of a drawing where no number is given: they cost nothing."""

_SEED_OF_DRAWINGS = 1_000_003

ShapeOption = Annotated[
    str | None,
    typer.Option(
        "--shape",
        help="Teach from a drawing, without grasping: as cylinder:diameter=6mm,length=20mm.",
    ),
]
MeshOption = Annotated[
    Path | None,
    typer.Option("--mesh", help="Teach from an STL file in mm, without grasping."),
]
GaugeOption = Annotated[
    Path | None,
    typer.Option("--gauge", help="Data set of grasps of one known object: calibrates the foam."),
]
GaugeShapeOption = Annotated[
    str | None,
    typer.Option("--gauge-shape", help="Shape of the gauge [default: the object of its label]."),
]


def teach_from_drawing(
    config: CellConfig,
    label: str,
    dataset: Path,
    *,
    shape: str | None,
    mesh: Path | None,
    n_grasps: int | None,
    gauge: Path | None,
    gauge_text: str | None,
    json_file: Path | None,
) -> None:
    """Add virtual grasps of a drawing to a data set, and say what they rest on."""
    if shape is not None and mesh is not None:
        raise ConfigError("--shape and --mesh are two drawings; give one of them")
    text = shape if shape is not None else f"mesh:file={mesh}"
    drawing = drawn_shape(text)
    known = pad_knowledge(config, gauge, gauge_text)
    before = read_dataset(dataset) if dataset.exists() else ()
    with progress_bar() as progress:
        grasps = teach_drawing(
            config,
            label,
            drawing,
            n_grasps or DEFAULT_GRASPS,
            kind=text.partition(":")[0],
            known=known,
            seed=_SEED_OF_DRAWINGS + config.seed + len(before),
            start_ms=max((grasp.start_ms + 1000 for grasp in before), default=0),
            progress=progress,
        )
    append_to_dataset(dataset, before, grasps)
    say(f"{len(grasps)} virtual grasps of {label} added to {dataset} ({len(before)} were there)")
    say(f"{known}")
    if known.rest is None:
        noise = config.simulator
        say(
            f"noise of the config (simulator.noise: {noise.noise}, level {noise.noise_level:g}); a "
            "sensor with more will take taught objects for unknown: --gauge brings its own noise"
        )
    write_json(
        json_file,
        {
            "label": label,
            "n_grasps": len(grasps),
            "dataset": str(dataset),
            "source": "drawing",
            "drawing": text,
            "pads": known.as_dict(),
        },
    )
