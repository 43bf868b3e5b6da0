"""What `teach --shape` does, and how shape and size are printed beside a label."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from cell.cli.output import progress_bar, say, write_json
from cell.collect import pad_array
from cell.config import CellConfig
from cell.dataset import read_dataset
from cell.errors import ConfigError
from cell.jobs.drawing import (
    PadKnowledge,
    calibrate_on_gauge,
    gauge_shape,
    shapes_of,
    teach_drawing,
    usual_foam,
)
from cell.jobs.teaching import append_to_dataset
from cell.layouts import layout_from_config
from cell.simulation import drawn_shape
from recognition.grasp import Grasp
from recognition.shape_answer import ShapeAnswer

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


def pad_knowledge(config: CellConfig, gauge: Path | None, gauge_text: str | None) -> PadKnowledge:
    """Return what a gauge tells of foam and sensor, or what is usual without one."""
    foam = usual_foam(config)
    if gauge is None:
        if gauge_text is not None:
            raise ConfigError("--gauge-shape describes the gauge; name its grasps with --gauge")
        return PadKnowledge(foam=foam)
    grasps = read_dataset(gauge)
    drawing = gauge_shape(grasps, gauge_text, config)
    pads = pad_array(layout_from_config(config.tactile))
    return calibrate_on_gauge(grasps, drawing, pads, foam)


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


def shape_texts(
    grasps: Sequence[Grasp], known: PadKnowledge
) -> tuple[list[str], list[dict[str, Any] | None]]:
    """Return shape and size of each grasp, as text to print and as plain data."""
    answers = shapes_of(grasps, known)
    return [_text(answer) for answer in answers], [
        None if answer is None else answer.as_dict() for answer in answers
    ]


def _text(answer: ShapeAnswer | None) -> str:
    return "no shape: not both pads were pressed" if answer is None else str(answer)
