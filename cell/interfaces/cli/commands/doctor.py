"""`doctor`: checks ports, servos and control unit."""

from pathlib import Path
from typing import Annotated

import typer

from cell.commissioning.doctor import examine
from cell.commissioning.findings import Verdict
from cell.errors import CellError
from cell.interfaces.cli import options
from cell.interfaces.cli.session import cell_config
from cell.interfaces.cli.terminal import out, print_line, show, write_json
from cell.plugins import GROUPS


def doctor(
    config: options.Config = None,
    json_file: options.Json = None,
    plugins: Annotated[
        bool, typer.Option("--plugins", help="Only list the installed plugins, and load each.")
    ] = False,
) -> None:
    """Check ports, servos and control unit; nothing moves.

    A commissioned cell is compared with the record of its commissioning.

    If the servo line or the sensor line does not answer, the other one is still checked.
    """
    if plugins:
        _list_plugins(json_file)
        return
    colours = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}
    findings = []
    for finding in examine(cell_config(config), config):
        findings.append(finding)
        advice = f"  -> {finding.advice}" if finding.advice else ""
        out.print(f"[{colours[finding.verdict]}]{finding.verdict.value:<5}[/]", end="")
        print_line(f" {finding.what}: {finding.text}{advice}")
    write_json(json_file, {"findings": findings})
    failed = sum(f.verdict is Verdict.FAIL for f in findings)
    if failed:
        raise CellError(f"{failed} of {len(findings)} checks failed")


def _list_plugins(json_file: Path | None) -> None:
    """Print each plugin, its package, and the reason if it does not load."""
    plugins = [plugin for group in GROUPS for plugin in group.examine()]
    states = [f"FAIL  {plugin.problem}" if plugin.problem else "loads" for plugin in plugins]
    lines = [
        f"{plugin.group:<12} {plugin.name:<18} {plugin.package:<20} {state}"
        for plugin, state in zip(plugins, states, strict=True)
    ]
    show(lines, {"plugins": plugins}, json_file)
    if failed := sum(bool(plugin.problem) for plugin in plugins):
        raise CellError(f"{failed} of {len(plugins)} plugins do not load")
