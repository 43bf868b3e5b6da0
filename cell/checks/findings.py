"""Findings of checks and of commissioning steps, and the file of the steps."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cell.config.file import problem_text
from cell.data.formats import COMMISSIONING, read_json
from cell.errors import CellError

STORE_NAME = "commissioning.json"
"""File in the cell's folder with the entries of the steps."""


class Verdict(StrEnum):
    """Result of a check or a step."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(slots=True, kw_only=True)
class Finding:
    """Results of a step so far; the engine keeps them, also if an error ends the step."""

    status: Verdict = Verdict.PASS
    """The worst status of its lines: WARN is usable, after FAIL the step must run again."""
    lines: list[str] = field(default_factory=list)
    """Lines for the operator: one fact each, a failed line with the next step."""
    values: dict[str, Any] = field(default_factory=dict)
    """Measured values for later steps, the record and `doctor`: any JSON values."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Values of the config by dotted key, as ``{"gripper.baud_rate": 1000000}``."""
    figures: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """Pictures by name, as numbers: see `cell.commissioning.figures`."""
    corrected: list[str] = field(default_factory=list)
    """Lines about errors that were corrected, with the new setting."""
    began: str = ""
    ended: str = ""
    """Wall-clock times of the step (ISO 8601, UTC); the engine sets them."""

    def fact(self, line: str, *, corrected: bool = False) -> None:
        """Add a line without a problem; ``corrected``: an error was corrected now."""
        self.lines.append(line)
        if corrected:
            self.corrected.append(line)

    def warn(self, line: str, *, corrected: bool = False) -> None:
        """Add a line with a warning for the operator; ``corrected`` as for `fact`."""
        self.fact(line, corrected=corrected)
        if self.status is Verdict.PASS:
            self.status = Verdict.WARN

    def fail(self, line: str) -> None:
        """Add a line with an error: the step must run again and sets nothing in the config."""
        self.lines.append(line)
        self.status = Verdict.FAIL

    @property
    def failed(self) -> bool:
        """Whether a line failed."""
        return self.status is Verdict.FAIL


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckResult:
    """Result of one check."""

    what: str
    """Checked item."""
    verdict: Verdict
    found: str
    """Finding, as text."""
    advice: str = ""
    """Next step; empty without a problem."""


def check_result(
    what: str, found: str, advice: str = "", *, ok: bool = False, bad: Verdict = Verdict.WARN
) -> CheckResult:
    """Return a result that passes if ``ok``, and else has the verdict ``bad`` and the advice."""
    verdict = Verdict.PASS if ok else bad
    return CheckResult(what=what, verdict=verdict, found=found, advice="" if ok else advice)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposedChange:
    """A write to a device, or a motion, which is shown before it is done."""

    where: str
    """Device or part that changes: ``servo 1``, ``finger 0``."""
    what: str
    """Item that changes, with its register or object if it has one."""
    before: str
    after: str
    """Present and new value with units; for a motion its start and its bounds."""
    undo: str
    """How to undo it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Approved:
    """A write or motion that the operator approved; kept also if the step was left or repeated."""

    step: str
    """Key of the step."""
    at: str
    """Wall-clock time (ISO 8601, UTC)."""
    write: ProposedChange


@dataclass(frozen=True, slots=True, kw_only=True)
class Commissioned:
    """Content of commissioning.json."""

    steps: dict[str, Finding]
    approved: list[Approved]


_STORE = TypeAdapter(Commissioned)


def read_commissioned(path: Path) -> Commissioned:
    """Return the content of commissioning.json; empty content without a file."""
    kept = read_json(path, COMMISSIONING, error=CellError)
    try:
        return _STORE.validate_python({"steps": {}, "approved": []} if kept is None else kept)
    except ValidationError as error:
        raise CellError(
            f"this program cannot read {path} ({problem_text(error)}): {COMMISSIONING.remedy}"
        ) from error


def kept_values(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Return the values of the steps in a folder by their keys; empty without a file.

    Raises CellError if commissioning.json cannot be read.
    """
    return {
        key: finding.values for key, finding in read_commissioned(folder / STORE_NAME).steps.items()
    }
