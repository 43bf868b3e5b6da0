"""Commands around the cell: the simulated cell for other programs, and the system check."""

import json
from pathlib import Path
from typing import Annotated

import typer

from cell.cli.options import ConfigOption, FaultOption, JsonOption, SeedOption
from cell.cli.output import out, say, write_json
from cell.cli.running import seeded
from cell.config_file import load_config
from cell.errors import CellError
from cell.jobs.doctor import Verdict, examine
from cell.jobs.simulating import serve_simulated_cell
from cell.simulation import fault_table

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
    faults: FaultOption = None,
    list_faults: Annotated[
        bool, typer.Option("--list-faults", help="Print every fault that there is, and end.")
    ] = False,
    with_parent: Annotated[
        bool, typer.Option("--with-parent", help="End with the program that started this one.")
    ] = False,
) -> None:
    """Run the simulated cell for other programs; prints one JSON line with its device paths."""
    if list_faults:
        for name, kind, value, meaning in fault_table():
            say(f"{name:<22} {kind:<13} {meaning}" + (f" [{value}]" if value else ""))
        return
    checked = seeded(load_config(config), seed)
    if faults:
        simulator = checked.simulator
        update = {"faults": (*simulator.faults, *faults)}
        checked = checked.model_copy(update={"simulator": simulator.model_copy(update=update)})
    serve_simulated_cell(
        checked,
        frames=frames,
        folder=folder,
        announce=lambda line: typer.echo(json.dumps(line)),
        until_parent_ends=with_parent,
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
