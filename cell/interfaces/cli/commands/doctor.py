"""`doctor`: checks machine, ports, servos and control unit."""

from cell.interfaces.cli.options import ConfigOption, JsonOption


def doctor(config: ConfigOption = None, json_file: JsonOption = None) -> None:
    """Check machine, ports, servos and control unit; nothing moves.

    Of two lines one may be missing: what the other one shows is listed.
    """
    from cell.commissioning.engine import Verdict
    from cell.errors import CellError
    from cell.interfaces.cli.session import cell_config
    from cell.interfaces.cli.terminal import out, print_line, write_json
    from cell.jobs.doctor import examine

    colours = {Verdict.PASS: "green", Verdict.WARN: "yellow", Verdict.FAIL: "bold red"}
    findings = []
    for finding in examine(cell_config(config), config):
        findings.append(finding)
        advice = f"  -> {finding.advice}" if finding.advice else ""
        out.print(f"[{colours[finding.verdict]}]{finding.verdict.value:<5}[/]", end="")
        print_line(f" {finding.what}: {finding.found}{advice}")
    write_json(
        json_file,
        {
            "findings": [
                {"what": f.what, "verdict": f.verdict.value, "found": f.found, "advice": f.advice}
                for f in findings
            ]
        },
    )
    failed = sum(f.verdict is Verdict.FAIL for f in findings)
    if failed:
        raise CellError(f"{failed} of {len(findings)} checks failed")
