"""Engine of the commissioning wizard: runs steps in turn, and keeps what each of them found.

A person may leave at any moment. What was found by then stands in commissioning.json of the
cell's folder, and the next run begins with the first step that is not done.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, NoReturn, Protocol

from cell.commissioning.bench import CONFIG_NAME, Bench
from cell.config.file import config_text, schema_text
from cell.data.files import write_atomically, write_text
from cell.errors import CellError, error_text
from gripper.errors import GripperError
from tactile.errors import TactileError

STORE_NAME = "commissioning.json"
"""File in the cell's folder that keeps the entries of the steps."""
LOOK_S = 0.05
"""Time in s between two calls of `Dialog.live` while motors move: a person may stop them there."""
_PNG = b"\x89PNG"
"""First bytes of a PNG picture."""
_VERSION = 1
"""Version of commissioning.json."""


class Left(CellError):
    """The person left the wizard, or refused a write; what was found before is kept."""


class Verdict(StrEnum):
    """How a check or a step ended."""

    PASS = "pass"
    WARN = "warn"
    FAIL = "fail"


@dataclass(frozen=True, slots=True, kw_only=True)
class Choice:
    """One of several answers."""

    key: str
    """What `Dialog.ask` returns."""
    text: str
    """What the person reads."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Number:
    """Range of a number that a person types."""

    lowest: float
    highest: float
    unit: str
    """Smallest and largest accepted value, in this unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Question:
    """What a person is asked: one of some choices, a number, or a free text without either."""

    key: str
    """Name of the question, the same in every run: ``step.subject``."""
    text: str
    choices: tuple[Choice, ...] | None = None
    number: Number | None = None
    default: str | float | None = None
    """Answer where the person just confirms; None where there is none."""


def confirmation(key: str, text: str, done: str = "done") -> Question:
    """Return a question that asks for something to be done by hand, and waits for it."""
    return Question(key=key, text=text, choices=(Choice(key="done", text=done),), default="done")


@dataclass(frozen=True, slots=True, kw_only=True)
class Write:
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
class Finding:
    """What a step found."""

    status: Verdict
    """PASS, WARN (usable, with a word to the operator) or FAIL (the step has to run again)."""
    lines: tuple[str, ...]
    """What a person reads: one fact a line, a failed one with what to do next."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Measured values for later steps, the record and `doctor`: anything that JSON can hold."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Values of the config by dotted key, as ``{"gripper.baud_rate": 1000000}``."""
    figures: Mapping[str, bytes | Mapping[str, Any]] = field(default_factory=dict)
    """Pictures by name: PNG or SVG bytes, or one of `cell.commissioning.figures`."""


class Dialog(Protocol):
    """The face of the wizard: terminal, page or script. Every call may raise `Left`."""

    def begin(self, step: "Step", number: int, count: int) -> None:
        """Show which step begins: its title and purpose, as ``number`` of ``count``."""
        ...

    def found(self, step: "Step", finding: Finding) -> None:
        """Show what a step found."""
        ...

    def say(self, text: str) -> None:
        """Show a text."""
        ...

    def live(self, name: str, value_text: str) -> None:
        """Show a value in the place of its previous one, while a person moves something."""
        ...

    def ask(self, question: Question, *, watch: Callable[[], str] | None = None) -> str | float:
        """Return the key of the chosen choice, the number, or the text typed.

        While the person has not answered, ``watch`` is called about ten times a second in the
        caller's thread, and its text shown as by `live`; its errors end the question.
        """
        ...

    def approve(self, writes: Sequence[Write]) -> None:
        """Show writes and motions before they are done; raises `Left` when they are refused."""
        ...


class Step(Protocol):
    """One step: finds something out, and sets it where the person approves."""

    @property
    def key(self) -> str:
        """Name in commissioning.json and for ``--redo``."""
        ...

    @property
    def title(self) -> str:
        """Heading."""
        ...

    @property
    def purpose(self) -> str:
        """What it finds, what it writes and what it moves, in a sentence or two."""
        ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Keys of the steps whose findings it uses; redoing one of them redoes this step."""
        ...

    @property
    def undo(self) -> str:
        """How a person takes back what it writes."""
        ...

    def run(self, bench: Bench, dialog: Dialog) -> Finding:
        """Carry it out, from the beginning even where it was left half done.

        Nothing is written or moved that `Dialog.approve` did not show. However it ends, no servo
        has torque that had none before, and nothing held is let go.

        Raises
        ------
        Left
            When the person leaves or refuses; nothing of the step is kept then.
        """
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """What commissioning.json keeps of a step."""

    finding: Finding
    began: str
    ended: str
    """Wall-clock times (ISO 8601, UTC)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Approved:
    """A write or motion that a person approved; kept also where the step was left or redone."""

    step: str
    """Key of the step."""
    at: str
    """Wall-clock time (ISO 8601, UTC)."""
    write: Write


class _Logged:
    """A dialog that logs what is approved; implements `Dialog`."""

    def __init__(self, dialog: Dialog, log: Callable[[Sequence[Write]], None]) -> None:
        self.begin, self.found, self.say = dialog.begin, dialog.found, dialog.say
        self.live, self.ask = dialog.live, dialog.ask
        self._approve, self._log = dialog.approve, log

    def approve(self, writes: Sequence[Write]) -> None:
        """Log the writes once they are approved."""
        self._approve(writes)
        self._log(writes)


class Engine:
    """Steps in their order, and what they found so far.

    Parameters
    ----------
    steps
        The steps; each stands behind those that it needs.
    bench
        What they work on; its settings and findings are filled from commissioning.json.
    finish
        Called with the engine once all steps are done and the config is written; returns the
        files that it wrote (the record).

    Raises
    ------
    CellError
        If commissioning.json cannot be read, or a step needs one that does not stand before it.
    """

    def __init__(
        self,
        steps: Sequence[Step],
        bench: Bench,
        *,
        finish: Callable[["Engine"], Sequence[Path]] = lambda _engine: (),
    ) -> None:
        self.steps = tuple(steps)
        self.bench = bench
        self._finish = finish
        known: list[str] = []
        for step in self.steps:
            missing = [key for key in step.needs if key not in known]
            if missing:
                raise CellError(f"step {step.key} needs {', '.join(missing)} before it")
            known.append(step.key)
        self.path = bench.folder / STORE_NAME
        kept, self.approved = _read(self.path)
        self.entries: dict[str, Entry] = {k: kept[k] for k in known if k in kept}
        self._fill_bench()

    def done(self, step: Step) -> bool:
        """Return whether a step has ended without a failure."""
        entry = self.entries.get(step.key)
        return entry is not None and entry.finding.status is not Verdict.FAIL

    def redo(self, key: str) -> tuple[str, ...]:
        """Forget a step and all that need it; return their keys.

        Raises
        ------
        CellError
            If there is no such step.
        """
        if key not in [step.key for step in self.steps]:
            names = ", ".join(step.key for step in self.steps)
            raise CellError(f"there is no step {key!r}; the steps are {names}")
        affected = {key}
        for step in self.steps:
            if affected.intersection(step.needs):
                affected.add(step.key)
        ordered = tuple(step.key for step in self.steps if step.key in affected)
        for name in ordered:
            self.entries.pop(name, None)
        self._store()
        return ordered

    def run(self, dialog: Dialog) -> tuple[Path, ...]:
        """Run the steps that are not done, then write the config; return the files written.

        A step that fails is run again, or the person leaves.

        Raises
        ------
        Left
            When the person leaves; a further run goes on with the same step.
        CellError
            If the files cannot be written, or the config that was found is not valid.
        """
        for number, step in enumerate(self.steps, start=1):
            while not self.done(step):
                dialog.begin(step, number, len(self.steps))
                self._run(step, dialog)
                if not self.done(step):
                    self._again(step, dialog)
        config = self.bench.folder / CONFIG_NAME
        schema = self.bench.folder / "tactile-cell.schema.json"
        write_text(config, config_text(self.bench.config), error=CellError, what="config")
        write_text(schema, schema_text(), error=CellError, what="schema")
        return (config, schema, *self._finish(self))

    def _run(self, step: Step, dialog: Dialog) -> None:
        def log(writes: Sequence[Write]) -> None:
            at = _now()
            self.approved += [Approved(step=step.key, at=at, write=write) for write in writes]
            self._store()

        began = _now()
        try:
            finding = step.run(self.bench, _Logged(dialog, log))
        except Left:
            raise
        except (CellError, GripperError, TactileError) as error:
            # A cable that was pulled, a disk that is full: mended, the step runs again.
            finding = Finding(status=Verdict.FAIL, lines=(error_text(error),))
        self.entries[step.key] = Entry(finding=finding, began=began, ended=_now())
        self._store()
        dialog.found(step, self.entries[step.key].finding)

    def _again(self, step: Step, dialog: Dialog) -> None:
        answer = dialog.ask(
            Question(
                key=f"{step.key}.again",
                text=f"{step.title} failed. Mend it, then run the step again.",
                choices=(
                    Choice(key="again", text="run the step again"),
                    Choice(key="leave", text="leave; what was found is kept"),
                ),
                default="again",
            )
        )
        if answer == "leave":
            leave(f"{step.title} failed")

    def _store(self) -> None:
        folder = self.bench.folder
        folder.mkdir(parents=True, exist_ok=True)
        for key, entry in self.entries.items():
            finding = entry.finding
            figures = {n: _stored(folder, key, n, f) for n, f in finding.figures.items()}
            shown = Finding(
                status=finding.status,
                lines=finding.lines,
                values=finding.values,
                settings=finding.settings,
                figures=figures,
            )
            self.entries[key] = Entry(finding=shown, began=entry.began, ended=entry.ended)
        steps = {
            key: {
                "status": entry.finding.status.value,
                "lines": list(entry.finding.lines),
                "values": entry.finding.values,
                "settings": entry.finding.settings,
                "figures": entry.finding.figures,
                "began": entry.began,
                "ended": entry.ended,
            }
            for key, entry in self.entries.items()
        }
        content = {"version": _VERSION, "steps": steps, "approved": [*map(asdict, self.approved)]}
        text = json.dumps(content, indent=2, allow_nan=False) + "\n"
        write_text(self.path, text, error=CellError, what="findings")
        self._fill_bench()

    def _fill_bench(self) -> None:
        self.bench.settings = {
            key: value
            for entry in self.entries.values()
            for key, value in entry.finding.settings.items()
        }
        self.bench.found = {key: entry.finding.values for key, entry in self.entries.items()}


def kept_values(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Return the values that the steps of a folder have found, by their keys; none without a file.

    Raises
    ------
    CellError
        If commissioning.json cannot be read.
    """
    entries, _approved = _read(folder / STORE_NAME)
    return {key: entry.finding.values for key, entry in entries.items()}


def leave(why: str) -> NoReturn:
    """Raise `Left` with the word how to go on."""
    raise Left(f"left: {why}. What was found is kept; run `tactile-cell commission` again to go on")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _stored(folder: Path, step: str, name: str, figure: Any) -> Any:
    """Return a figure as commissioning.json keeps it: numbers, or ``{"file": name}``."""
    if not isinstance(figure, bytes):
        return figure
    file = f"{step}-{name}.{'png' if figure.startswith(_PNG) else 'svg'}"
    write_atomically(folder / file, lambda out: out.write(figure), error=CellError, what="figure")
    return {"file": file}


def _read(path: Path) -> tuple[dict[str, Entry], list[Approved]]:
    """Return entries and log of commissioning.json; none where there is no such file."""
    try:
        data = json.loads(path.read_text("utf-8"))
        if data["version"] != _VERSION:
            raise CellError(
                f"{path} is of version {data['version']}, this program reads {_VERSION}: "
                "move it away to commission anew"
            )
        entries = {
            key: Entry(
                finding=Finding(
                    status=Verdict(item["status"]),
                    lines=tuple(item["lines"]),
                    values=item["values"],
                    settings=item["settings"],
                    figures=item["figures"],
                ),
                began=item["began"],
                ended=item["ended"],
            )
            for key, item in data["steps"].items()
        }
        approved = [
            Approved(step=item["step"], at=item["at"], write=Write(**item["write"]))
            for item in data["approved"]
        ]
    except FileNotFoundError:
        return {}, []
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CellError(
            f"{path} cannot be read ({type(error).__name__}: {error}): move it away to commission "
            "anew"
        ) from error
    return entries, approved
