"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", "-c", help="Config file; without one, the simulated cell."),
]
JsonOption = Annotated[
    Path | None, typer.Option("--json", help="Also write what is printed to this file, as JSON.")
]
OutOption = Annotated[
    Path | None,
    typer.Option("--out", help="Folder for recordings and reports [default: recording.directory]."),
]
SeedOption = Annotated[
    int | None, typer.Option("--seed", help="Seed of poses and noise [default: seed].", min=0)
]
ModelOption = Annotated[Path | None, typer.Option("--model", "-m", help="File of a taught model.")]
FaultOption = Annotated[
    list[str] | None,
    typer.Option(
        "--fault",
        metavar="FAULT",
        help="Fault of the simulated cell, as can.loss=0.05@2s; repeat for several "
        "(simulate --list-faults).",
    ),
]
CaptureOption = Annotated[
    Path | None,
    typer.Option("--capture", help="Write the simulated CAN traffic to this pcap file."),
]
