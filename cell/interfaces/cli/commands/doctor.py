"""`doctor`: checks machine, ports, servos and control unit."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from cell.checks.findings import Finding, Verdict
from cell.commissioning.baseline import gauge_again
from cell.commissioning.bench import Bench
from cell.commissioning.doctor import examine
from cell.errors import CellError
from cell.interfaces.cli import options
from cell.interfaces.cli.dialog import TerminalDialog
from cell.interfaces.cli.session import cell_config
from cell.interfaces.cli.terminal import out, print_line, show, write_json
from cell.plugins import GROUPS


def doctor(
    config: options.Config = None,
    json_file: options.Json = None,
    gauge: Annotated[
        bool,
        typer.Option(
            "--gauge",
            help="Also grasp the gauge object of the commissioning and compare: the fingers move.",
        ),
    ] = False,
    plugins: Annotated[
        bool,
        typer.Option("--plugins", help="Only list the installed plugins, and load each."),
    ] = False,
) -> None:
    """Check machine, ports, servos and control unit; nothing moves without --gauge.

    A commissioned cell is compared with the record of its commissioning.

    If one of the two lines is missing, the other line is still checked.
    """
    if plugins:
        _list_plugins(json_file)
        return
    colours = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}
    findings = []
    cell = cell_config(config)

    def checks() -> Iterator[Finding]:
        yield from examine(cell, config)
        if gauge:
            if config is None or cell.simulated:
                raise CellError("--gauge is for a commissioned cell with real ports: name --config")
            yield from gauge_again(Bench(config.parent), cell, TerminalDialog())

    for finding in checks():
        findings.append(finding)
        advice = f"  -> {finding.advice}" if finding.advice else ""
        out.print(f"[{colours[finding.verdict]}]{finding.verdict.value:<5}[/]", end="")
        print_line(f" {finding.what}: {finding.found}{advice}")
    write_json(json_file, {"findings": findings})
    failed = sum(f.verdict is Verdict.FAIL for f in findings)
    if failed:
        raise CellError(f"{failed} of {len(findings)} checks failed")


def _list_plugins(json_file: Path | None) -> None:
    """Print each plugin, its package, and the reason if it does not load."""
    found = [plugin for group in GROUPS for plugin in group.examine()]
    states = [f"FAIL  {one.problem}" if one.problem else "loads" for one in found]
    lines = [
        f"{one.group:<12} {one.name:<18} {one.package:<20} {state}"
        for one, state in zip(found, states, strict=True)
    ]
    show(lines, {"plugins": found}, json_file)
    if failed := sum(bool(one.problem) for one in found):
        raise CellError(f"{failed} of {len(found)} plugins do not load")
