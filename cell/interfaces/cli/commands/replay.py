"""`replay`: sends recorded grasps through the real protocols and compares what arrives."""

from pathlib import Path
from typing import Annotated

import typer

from cell.interfaces.cli.options import CaptureOption, JsonOption, RecognizerOption, SplitOption
from recognition.recognizers import DEFAULT_TRAINER

_UPLOAD_WITHIN_S = 60.0
"""Time in s within which a recording that is dropped on the page is sent and read."""

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
        int | None, typer.Option("--limit", min=1, help="Most grasps to replay [default: all].")
    ] = None,
    recognizer: RecognizerOption = DEFAULT_TRAINER,
    config: ReplayConfigOption = None,
    capture: CaptureOption = None,
    json_file: JsonOption = None,
    live: Annotated[
        bool,
        typer.Option(
            "--live", help="Show the recording on the page instead, as if it were measured now."
        ),
    ] = False,
    http_port: Annotated[
        int | None,
        typer.Option("--http", help="Port of the page [default: 8080, or the next free one]."),
    ] = None,
) -> None:
    """Send recorded grasps through the real protocols and compare.

    What arrives is identified, too. With --live a recording is played on the page for a browser,
    until SIGTERM: its address is printed on standard error, one JSON line with it on standard
    output.
    """
    if live:
        _play(source, http_port)
        return
    from cell.config.file import load_config
    from cell.data.dataset import read_grasps
    from cell.errors import CellError
    from cell.interfaces.cli.terminal import (
        percent,
        print_line,
        print_note,
        progress_bar,
        write_json,
    )
    from cell.jobs.replay import replay_grasps

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
    print_line(
        f"{result.n_grasps} grasps: {result.frames_sent} frames sent, "
        f"{result.frames_received} received, {same}"
    )
    print_line(
        f"openings differ by at most {result.aperture_error_m * 1e3:.3f} mm: servos report pulses"
    )
    if result.accuracy is not None:
        print_line(f"named right by one grasp: {percent(result.accuracy, result.interval)}")
    else:
        print_note(f"no grasp is named: {result.unnamed}")
    write_json(json_file, result.as_json())
    if not result.frames_equal:
        raise CellError(f"frames differ: {result.difference}")


def _play(source: Path, http_port: int | None) -> None:
    """Show a recording through the doors of a service, for clients of this machine."""
    import threading

    from cell.config.model import CellConfig
    from cell.config.serve import ServeConfig
    from cell.interfaces.cli.commands.serve import SIGNAL_LOOK_S, announced_doors, free_page_port
    from cell.interfaces.cli.signals import END_WITHIN_S, stopping
    from cell.interfaces.cli.terminal import print_note
    from cell.interfaces.service.replay import Replay
    from cell.interfaces.service.service import Service

    replay = Replay(source)
    if reason := replay.values()["lost_reason"]:
        print_note(f"{source} is not complete: {reason}; what is whole is shown")
    port = free_page_port("127.0.0.1") if http_port is None else http_port
    doors = ServeConfig(
        modbus_port=None, xmlrpc_port=None, http_port=port, request_timeout_s=_UPLOAD_WITHIN_S
    )
    over = threading.Event()
    with (
        stopping(over.set, end_within_s=END_WITHIN_S),
        announced_doors(Service(replay, CellConfig(serve=doors), note=print_note)),
    ):
        while not over.wait(SIGNAL_LOOK_S):
            pass
