"""`recover`: saves the undamaged data of a damaged recording."""

from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import JsonOption, RecordingOutOption


def recover(
    recording: Annotated[Path, typer.Argument(help="Truncated or damaged recording.")],
    output: RecordingOutOption = None,
    json_file: JsonOption = None,
) -> None:
    """Save the undamaged data of a damaged recording to a new file."""
    from cell.data.recording_reader import recover_recording
    from cell.interfaces.cli.terminal import print_line, write_json

    target = output or recording.with_name(f"{recording.stem}-recovered.mcap")
    found = recover_recording(recording, target)
    print_line(f"{recording}: {found.lost_reason or 'complete, nothing is lost'}")
    print_line(
        f"{found.recording}: {found.n_frames} frames, {found.n_cycles} periods of the loop, "
        f"{found.n_grasps} whole grasps; {found.n_broken_grasps} broken grasps are left out"
    )
    write_json(json_file, found)
