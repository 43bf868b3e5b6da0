"""`report`: writes the report page of a recording."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    recording: Annotated[
        Path, typer.Argument(help="Recording of a run, an identification or a sort.")
    ],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Page to write [default: report.html beside the recording]."
        ),
    ] = None,
) -> None:
    """Write the report page of a recording: one HTML file for a browser.

    Needs the extra `report`.
    """
    from cell.data.recording_reader import read_recording
    from cell.interfaces.cli.terminal import print_line
    from cell.report.page import write_report
    from cell.report.recorded import recorded_report

    page = output or recording.with_name("report.html")
    write_report(page, recorded_report(read_recording(recording)))
    print_line(f"report: {page}")
