"""Commands around the cell: the simulated cell for other programs, and the system check."""

import json
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.options import ConfigOption, JsonOption, SeedOption
from cell.cli.output import out, say, write_json
from cell.config_file import load_config
from cell.errors import CellError
from cell.jobs.doctor import Verdict, examine
from cell.jobs.simulating import serve_simulated_cell

_COLOURS = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}


def simulate(
    frames: Annotated[
        Path | None, typer.Option("--frames", help="Play the grasps of this data set instead.")
    ] = None,
    config: ConfigOption = None,
    folder: Annotated[
        Path | None, typer.Option("--out", help="Folder for device links and the ready config.")
    ] = None,
    seed: SeedOption = None,
) -> None:
    """Run the simulated cell for other programs; prints one JSON line with its device paths."""
    checked = load_config(config)
    if seed is not None:
        checked = checked.model_copy(update={"seed": seed})
    serve_simulated_cell(
        checked, frames=frames, folder=folder, announce=lambda line: typer.echo(json.dumps(line))
    )


def doctor(config: ConfigOption = None, json_file: JsonOption = None) -> None:
    """Check machine, ports, servos and control unit; nothing moves."""
    findings = []
    for finding in examine(load_config(config)):
        findings.append(finding)
        advice = f"  -> {finding.advice}" if finding.advice else ""
        colour = _COLOURS[finding.verdict]
        out.print(f"[{colour}]{finding.verdict.value:<5}[/]", end="")
        say(f" {finding.what}: {finding.found}{advice}")
    write_json(
        json_file,
        {
            "findings": [
                {
                    "what": f.what,
                    "verdict": f.verdict.value,
                    "found": f.found,
                    "advice": f.advice,
                }
                for f in findings
            ]
        },
    )
    failed = sum(f.verdict is Verdict.FAIL for f in findings)
    if failed:
        raise CellError(f"{failed} of {len(findings)} checks failed")
