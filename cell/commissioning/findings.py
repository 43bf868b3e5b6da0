"""Findings of steps and of the system check, and the file of the steps."""

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from shlex import quote
from typing import Any

from pydantic import TypeAdapter

from cell.errors import CellError, raised_as
from cell.files import COMMISSIONING, read_json

STORE_NAME = "commissioning.json"
"""File in the cell's folder with the entries of the steps."""


def commission_command(folder: Path) -> str:
    """Return the command of a commissioning in a folder."""
    return "tactile-cell commission" + ("" if folder == Path() else f" {quote(str(folder))}")


class Verdict(StrEnum):
    """Result of a check or a step."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One finding of a check or of a step."""

    what: str = ""
    """Checked item; empty for a finding of a step."""
    verdict: Verdict = Verdict.PASS
    text: str
    """What was read or measured."""
    advice: str = ""
    """Next step; empty without a problem."""
    corrected: bool = False
    """Whether an error was corrected now; then it has the new setting."""

    @property
    def line(self) -> str:
        """Finding and advice as one line for the operator."""
        return f"{self.text}: {self.advice}" if self.advice else self.text


def check_result(
    what: str, text: str, advice: str = "", *, ok: bool = False, bad: Verdict = Verdict.WARN
) -> Finding:
    """Return a finding that passes if ``ok``, and else has the verdict ``bad`` and the advice."""
    verdict = Verdict.PASS if ok else bad
    return Finding(what=what, verdict=verdict, text=text, advice="" if ok else advice)


@dataclass(slots=True, kw_only=True)
class Notes:
    """Results of a step so far; the engine keeps them, also if an error ends the step."""

    findings: list[Finding] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=dict)
    """Measured values for later steps, the record and `doctor`: any JSON values."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Values of the config by dotted key, as ``{"gripper.baud_rate": 1000000}``."""
    began: str = ""
    ended: str = ""
    """Wall-clock times of the step (ISO 8601, UTC); the engine sets them."""

    def fact(self, line: str, *, corrected: bool = False) -> None:
        """Add a finding without a problem; ``corrected``: an error was corrected now."""
        self.findings.append(Finding(text=line, corrected=corrected))

    def warn(self, line: str, *, corrected: bool = False) -> None:
        """Add a warning for the operator; ``corrected`` as for `fact`."""
        self.findings.append(Finding(verdict=Verdict.WARN, text=line, corrected=corrected))

    def fail(self, line: str) -> None:
        """Add an error: the step must run again and sets nothing in the config."""
        self.findings.append(Finding(verdict=Verdict.FAIL, text=line))

    @property
    def status(self) -> Verdict:
        """The worst verdict: WARN is usable, after FAIL the step must run again."""
        return max(
            (finding.verdict for finding in self.findings),
            key=[*Verdict].index,
            default=Verdict.PASS,
        )

    @property
    def failed(self) -> bool:
        """Whether a finding failed."""
        return self.status is Verdict.FAIL

    @property
    def lines(self) -> list[str]:
        """The findings as lines."""
        return [finding.line for finding in self.findings]

    @property
    def corrected(self) -> list[str]:
        """Lines about errors that were corrected; none of a step that failed."""
        return [] if self.failed else [item.line for item in self.findings if item.corrected]


@dataclass(frozen=True, slots=True)
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
    step: str = ""
    at: str = ""
    """Key of the step and wall-clock time (ISO 8601, UTC) of the approval; the engine sets them."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Commissioned:
    """Content of commissioning.json."""

    steps: dict[str, Notes]
    approved: list[ProposedChange]
    """Approved writes and motions; kept also if their step was left or repeated."""


def read_commissioned(path: Path) -> Commissioned:
    """Return the content of commissioning.json; empty content without a file.

    Raises CellError if it is damaged or of another format.
    """
    content = read_json(path, COMMISSIONING, error=CellError) or {"steps": {}, "approved": []}
    with raised_as(CellError, ValueError, where=f"{path} is damaged; move it away, or restore it"):
        return TypeAdapter(Commissioned).validate_python(content)
