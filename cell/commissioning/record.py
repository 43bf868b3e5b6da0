"""Record of a commissioning: one HTML file with every step, write and picture, to sign and file."""

import platform
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from cell.checks.findings import Finding, Verdict
from cell.commissioning.engine import Engine, Step
from cell.commissioning.figures import element
from cell.data.files import write_text
from cell.errors import CellError
from cell.report.page import page_template

RECORD_NAME = "commissioning.html"
"""File in the cell's folder."""
_HARDWARE = ("serial", "firmware", "model", "revision", "hardware", "layout")
"""Parts of the names of values that identify the commissioned hardware."""
_LONGEST_LIST = 8
"""Longest printed list; longer ones are in the figures, or in commissioning.json."""


def write_record(engine: Engine) -> tuple[Path, ...]:
    """Write the record of the findings so far as self-contained HTML; return its path.

    Raises CellError if the disk refuses, or the packages of the extra ``report`` are missing
    (MissingExtraError).
    """
    folder = engine.bench.folder
    path = folder / RECORD_NAME
    findings = engine.findings
    verdicts = [one.status for one in findings.values()]
    page = page_template("commissioning.html.j2").render(
        cell=engine.bench.config.name,
        began=min((_time(one.began) for one in findings.values()), default=""),
        ended=max((_time(one.ended) for one in findings.values()), default=""),
        program=f"tactile-cell {version('tactile-cell')}",
        machine=f"{platform.node()}, {platform.system()} {platform.release()}, "
        f"Python {platform.python_version()}",
        counts=[(verdict.value, verdicts.count(verdict)) for verdict in Verdict],
        n_steps=len(engine.steps),
        hardware=[
            (f"{step}: {name}", value)
            for step, finding in findings.items()
            for name, value in _flat(finding.values)
            if any(part in name.lower() for part in _HARDWARE)
        ],
        corrected=engine.corrected,
        steps=[_step_view(engine, step) for step in engine.steps],
        settings=[(name, _text(value)) for name, value in engine.bench.settings.items()],
        folder=folder.resolve(),
    )
    write_text(path, page, error=CellError, what="record")
    return (path,)


def _step_view(engine: Engine, step: Step) -> dict[str, Any]:
    """Return the values of a step for the template."""
    done = step.key in engine.findings
    finding = engine.findings[step.key] if done else Finding(status=Verdict.FAIL)
    writes = [one for one in engine.approved if one.step == step.key]
    return {
        "key": step.key,
        "title": step.title,
        "undo": step.undo,
        "writes": [{"at": _time(one.at), **asdict(one.write)} for one in writes],
        "status": finding.status.value if done else "not done",
        "time": f"{_time(finding.began)} to {_time(finding.ended)}" if done else "",
        "lines": finding.lines,
        "measured": list(_flat(finding.values)),
        "figures": [(figure["title"], element(figure)) for figure in finding.figures.values()],
    }


def _flat(values: Mapping[str, Any], way: str = "") -> Iterator[tuple[str, str]]:
    """Yield the name and text of each value, those of nested mappings by a dotted name."""
    for name, value in values.items():
        place = f"{way}.{name}" if way else str(name)
        if isinstance(value, Mapping):
            yield from _flat(value, place)
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            for number, one in enumerate(value):
                yield from _flat(one, f"{place}.{number}")
        elif not (isinstance(value, list | tuple) and len(value) > _LONGEST_LIST):
            yield place, _text(value)


def _time(iso: str) -> str:
    """Return a wall-clock time of commissioning.json for people."""
    return iso.replace("T", " ").replace("+00:00", " UTC")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    if isinstance(value, Mapping):
        return " ".join(f"{name}: {_text(one)};" for name, one in value.items()).rstrip(";")
    return str(value)
