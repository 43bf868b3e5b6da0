"""Findings of checks and of commissioning steps, and the file that keeps the latter."""

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
"""File in the cell's folder that keeps the entries of the steps."""


class Verdict(StrEnum):
    """How a check or a step ended."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(slots=True, kw_only=True)
class Finding:
    """What a step has found so far; the engine keeps it, also where an error ends the step."""

    status: Verdict = Verdict.PASS
    """The worst of its lines: WARN is usable, after FAIL the step has to run again."""
    lines: list[str] = field(default_factory=list)
    """What a person reads: one fact a line, a failed one with what to do next."""
    values: dict[str, Any] = field(default_factory=dict)
    """Measured values for later steps, the record and `doctor`: anything that JSON can hold."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Values of the config by dotted key, as ``{"gripper.baud_rate": 1000000}``."""
    figures: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    """Pictures by name, as numbers: see `cell.commissioning.figures`."""
    corrected: list[str] = field(default_factory=list)
    """Those of its lines that say what was wrong, and what it is set to now."""
    began: str = ""
    ended: str = ""
    """Wall-clock times of the step (ISO 8601, UTC), which the engine sets."""

    def fact(self, line: str, *, corrected: bool = False) -> None:
        """Add a line that is as it should be; ``corrected``: by what was set now."""
        self.lines.append(line)
        if corrected:
            self.corrected.append(line)

    def warn(self, line: str, *, corrected: bool = False) -> None:
        """Add a line that is worth a word to the operator; ``corrected`` as for `fact`."""
        self.fact(line, corrected=corrected)
        if self.status is Verdict.PASS:
            self.status = Verdict.WARN

    def fail(self, line: str) -> None:
        """Add a line for which the step has to run again; it sets nothing in the config then."""
        self.lines.append(line)
        self.status = Verdict.FAIL

    @property
    def failed(self) -> bool:
        """Whether a line failed."""
        return self.status is Verdict.FAIL


@dataclass(frozen=True, slots=True, kw_only=True)
class CheckResult:
    """One checked thing."""

    what: str
    """What was checked."""
    verdict: Verdict
    """How it ended."""
    found: str
    """What was found."""
    advice: str = ""
    """What to do; empty where all is well."""


def check_result(
    what: str, found: str, advice: str = "", *, ok: bool = False, bad: Verdict = Verdict.WARN
) -> CheckResult:
    """Return a result that passes where all is ok, and else has a verdict and the advice."""
    verdict = Verdict.PASS if ok else bad
    return CheckResult(what=what, verdict=verdict, found=found, advice="" if ok else advice)


@dataclass(frozen=True, slots=True, kw_only=True)
class ProposedChange:
    """A write to a device, or a motion, as it is shown before it is done."""

    where: str
    """Device or part that changes: ``servo 1``, ``finger 0``."""
    what: str
    """Item that changes, with its register or object where it has one."""
    before: str
    after: str
    """Present and coming value with units; for a motion its start, and its bounds."""
    undo: str
    """How it is taken back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Approved:
    """A write or motion that a person approved; kept also where the step was left or redone."""

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
    """Return the content of commissioning.json; an empty one where there is no such file."""
    kept = read_json(path, COMMISSIONING, error=CellError)
    try:
        return _STORE.validate_python({"steps": {}, "approved": []} if kept is None else kept)
    except ValidationError as error:
        raise CellError(
            f"{path} cannot be read by this program ({problem_text(error)}): {COMMISSIONING.remedy}"
        ) from error


def kept_values(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Return the values that the steps of a folder have found, by their keys; none without a file.

    Raises CellError if commissioning.json cannot be read.
    """
    return {
        key: finding.values for key, finding in read_commissioned(folder / STORE_NAME).steps.items()
    }
