"""`recording replay`: sends recorded grasps through the real protocols and compares the result."""

from pathlib import Path
from typing import Annotated

import typer

from cell.config.file import load_config
from cell.data.dataset import read_grasps
from cell.errors import CellError
from cell.interfaces.cli.options import CaptureOption, JsonOption, RecognizerOption, SplitOption
from cell.interfaces.cli.terminal import (
    percent,
    print_note,
    progress_bar,
    show,
)
from cell.runtime.replay import replay_grasps
from recognition.recognizers import DEFAULT_TRAINER

ReplayConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help="Config file of the cell [default: one made for the grasps' pads]."
    ),
]


def replay(
    source: Annotated[Path, typer.Argument(help="Data set or recording.")],
    split: SplitOption = "chronological:0.6",
    limit: Annotated[
        int | None, typer.Option("--limit", min=1, help="Replay at most so many [default: all].")
    ] = None,
    recognizer: RecognizerOption = DEFAULT_TRAINER,
    config: ReplayConfigOption = None,
    capture: CaptureOption = None,
    json_file: JsonOption = None,
) -> None:
    """Send recorded grasps through the real protocols, compare, and identify them."""
    with progress_bar() as progress:
        result = replay_grasps(
            read_grasps(source),
            load_config(config) if config is not None else None,
            split=split,
            limit=limit,
            recognizer=recognizer,
            capture=capture,
            progress=progress,
        )
    same = "bit for bit the same" if result.frames_equal else "NOT the same"
    lines = [
        f"{result.n_grasps} grasps: {result.frames_sent} frames sent, "
        f"{result.frames_received} received, {same}",
        f"openings differ by at most {result.aperture_error_mm:.3f} mm: servos report pulses",
    ]
    if result.accuracy is not None:
        lines.append(f"named right by one grasp: {percent(result.accuracy, result.interval)}")
    else:
        print_note(f"no grasp was identified: {result.unnamed}")
    show(lines, result, json_file)
    if not result.frames_equal:
        raise CellError(f"frames differ: {result.difference}")
