"""Engine of the commissioning wizard: runs the steps in order, and saves their findings.

A person may leave at any moment. The findings are in commissioning.json of the cell's folder, and
the next run begins with the first step that is not done.
"""

import json
import platform
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn, Protocol

from cell.commissioning.bench import BASE_NAME, CONFIG_NAME, Bench
from cell.commissioning.findings import STORE_NAME, Notes, ProposedChange, read_commissioned
from cell.config.file import config_text, schema_text
from cell.errors import CellError
from cell.fault_catalogue import EXPECTED_ERRORS, error_text
from cell.files import COMMISSIONING, free_name, write_json, write_text

RECORD_NAME = "commissioning.md"
"""File in the cell's folder: each step, finding, value and write, to sign and file."""
_LONGEST = 100
"""Characters of a value above which it is in commissioning.json only."""
LIVE_CALL_S = 0.05
"""Time in s between two calls of `Dialog.live` while motors move: a person may stop them there."""


class StepFailed(CellError):
    """A step has failed; the message has the cause and the next step."""


class WizardAborted(CellError):
    """The person left the wizard, or refused a write; earlier findings are kept."""


Answers = Mapping[str, str]
"""Text of each answer, by its key; a picture may follow in further lines."""
Limits = tuple[float, float, str]
"""Least and largest number that is accepted, and its unit."""
Watch = Callable[[], str] | None
"""Text that is shown until the answer: called about ten times a second in the caller's thread. Its
errors end the question."""


class Dialog(Protocol):
    """User interface of the wizard: terminal or script. Calls may raise `WizardAborted`.

    The key of a question is the same in every run: ``step.subject``. ``default`` is the answer on a
    plain confirmation.
    """

    log: Callable[[Sequence[ProposedChange]], None] | None = None
    """Gets the approved writes of a step; the engine sets it."""

    def start_step(self, step: "Step", number: int, count: int) -> None:
        """Show the step that begins: its title and purpose, as ``number`` of ``count``."""

    def show(self, step: "Step", notes: Notes) -> None:
        """Show the findings of a step."""

    def say(self, text: str) -> None:
        """Show a text."""

    def live(self, name: str, value_text: str) -> None:
        """Show a value instead of its previous one, while a person moves something."""

    def choose(
        self, key: str, text: str, answers: Answers, default: str | None = None, watch: Watch = None
    ) -> str:
        """Ask for one of some answers; return its key."""

    def number(
        self, key: str, text: str, limits: Limits, default: float | None = None, watch: Watch = None
    ) -> float:
        """Ask for a number within limits; return it."""

    def confirm(self, key: str, text: str, done: str = "done", watch: Watch = None) -> None:
        """Ask for an action by hand, and wait for it."""
        self.choose(key, text, {"done": done}, "done", watch)

    def ask_consent(self, writes: Sequence[ProposedChange]) -> None:
        """Show changes and motions before they are done; raises `WizardAborted` on refusal."""

    def approve(self, writes: Sequence[ProposedChange]) -> None:
        """Ask for consent as `ask_consent`, then log the writes."""
        self.ask_consent(writes)
        if self.log is not None:
            self.log(writes)


@dataclass(frozen=True, slots=True)
class Step:
    """One step: measures something, and sets it if the person approves."""

    run: Callable[[Bench, Dialog, Notes], None]
    """Runs the step from its start, also after an earlier partial run, and notes its findings.

    Nothing is written or moved without `Dialog.approve`. After it, also after an error, no servo
    has torque that had none before, and a held part stays held. Raises WizardAborted when the
    person leaves or refuses. CellError, GripperError and TactileError end the step; `carry_out`
    adds them to the notes. Its docstring is for the person: what it finds, writes and moves."""
    key: str
    """Name in commissioning.json and for ``--redo``."""
    title: str
    needs: tuple[str, ...] = ()
    """Keys of the steps before it whose findings it uses; redoing one of them redoes this step."""

    @property
    def purpose(self) -> str:
        """What the step does, for the person, as one line."""
        return " ".join((self.run.__doc__ or "").split())


def carry_out(step: Step, bench: Bench, dialog: Dialog) -> Notes:
    """Run a step and return its notes; an error of cell or lines is a failure of the step.

    Raises WizardAborted when the person leaves or refuses.
    """
    notes = Notes(began=_now())
    earlier = bench.settings
    bench.settings = ChainMap(notes.settings, dict(earlier))
    try:
        step.run(bench, dialog, notes)
    except WizardAborted:
        raise
    except EXPECTED_ERRORS as error:
        # A pulled cable, a full disk: after the repair the step runs again.
        notes.fail(error_text(error))
    finally:
        bench.settings = earlier
    if notes.failed:
        notes.settings.clear()
    notes.ended = _now()
    return notes


class Engine:
    """Steps in their order, and their findings so far.

    Raises CellError if commissioning.json cannot be read.

    Parameters
    ----------
    steps
        The steps; each comes after the steps that it needs.
    bench
        Lines and config; its settings and findings are filled from commissioning.json.
    """

    def __init__(self, steps: Sequence[Step], bench: Bench) -> None:
        self.steps = tuple(steps)
        self.bench = bench
        self.path = bench.folder / STORE_NAME
        earlier = read_commissioned(self.path)
        self.approved = earlier.approved
        keys = [step.key for step in self.steps]
        self.notes = {key: earlier.steps[key] for key in keys if key in earlier.steps}
        self._fill_bench()

    def done(self, step: Step) -> bool:
        """Return whether a step has ended without a failure."""
        return step.key in self.notes and not self.notes[step.key].failed

    @property
    def corrected(self) -> list[str]:
        """Corrected settings of the cell, with their new values, in the order of the steps."""
        done = (self.notes[step.key] for step in self.steps if step.key in self.notes)
        return [line for notes in done for line in notes.corrected]

    def affected(self, *keys: str) -> tuple[str, ...]:
        """Return the keys of some steps and of all that need them.

        Raises CellError if a step does not exist.
        """
        names = [step.key for step in self.steps]
        for key in keys:
            if key not in names:
                raise CellError(f"there is no step {key!r}; the steps are {', '.join(names)}")
        affected = set(keys)
        for step in self.steps:
            if affected.intersection(step.needs):
                affected.add(step.key)
        return tuple(name for name in names if name in affected)

    def redo(self, *keys: str) -> None:
        """Forget some steps and all that need them; raises as `affected`."""
        for name in self.affected(*keys):
            self.notes.pop(name, None)
        self._store()

    def run(self, dialog: Dialog) -> tuple[Path, ...]:
        """Run the steps that are not done, then write config, schema and record; return the files.

        A failed step runs again, or the person leaves. Raises WizardAborted then; a further run
        continues with the same step. Raises CellError if the files cannot be written, or if the
        config is not valid.
        """
        for number, step in enumerate(self.steps, start=1):
            while not self.done(step):
                dialog.start_step(step, number, len(self.steps))
                self._run(step, dialog)
                if not self.done(step):
                    text = f"{step.title} failed. Correct the cause, then run the step again."
                    dialog.confirm(f"{step.key}.again", text, "run the step again")
        texts = {
            CONFIG_NAME: config_text(self.bench.config),
            "tactile-cell.schema.json": schema_text(),
            RECORD_NAME: self.record(),
        }
        config = self.bench.folder / CONFIG_NAME
        if config.exists() and (before := config.read_text("utf-8")) != texts[CONFIG_NAME]:
            write_text(backup := free_name(config), before, error=CellError, what="earlier config")
            dialog.say(f"{CONFIG_NAME} changes; the earlier one with its comments is {backup}")
        for name, text in texts.items():
            write_text(self.bench.folder / name, text, error=CellError, what=name)
        return tuple(self.bench.folder / name for name in texts)

    def record(self) -> str:
        """Return the record as Markdown: each step with its findings, values and writes."""
        system = f"{platform.system()} {platform.release()}, Python {platform.python_version()}"
        lines = [
            f"# Commissioning of {self.bench.config.name}\n",
            f"tactile-cell {version('tactile-cell')} on {platform.node()}, {system}\n",
            "## Errors found and corrected\n",
            *(f"- {line}" for line in self.corrected or ["none"]),
        ]
        for step in self.steps:
            lines.append(f"\n## {step.title}\n")
            if notes := self.notes.get(step.key):
                lines.append(f"{notes.status}, {notes.began} to {notes.ended}\n")
                lines += [f"- {line}" for line in notes.lines]
                for name, value in (notes.settings | notes.values).items():
                    text = json.dumps(value, default=list)
                    if name in notes.settings or len(text) < _LONGEST:
                        lines.append(f"- {name}: {text}")
            else:
                lines.append("not done\n")
            for write in (write for write in self.approved if write.step == step.key):
                change = f"{write.where}: {write.what}: {write.before} -> {write.after}"
                lines.append(f"- approved {write.at}: {change}; undo: {write.undo}")
        return "\n".join([*lines, "\nDate, name, signature:\n"])

    def _run(self, step: Step, dialog: Dialog) -> None:
        def log(writes: Sequence[ProposedChange]) -> None:
            at = _now()
            self.approved += [replace(write, step=step.key, at=at) for write in writes]
            self._store()

        dialog.log = log
        notes = carry_out(step, self.bench, dialog)
        self.notes[step.key] = notes
        self._store()
        dialog.show(step, notes)

    def _store(self) -> None:
        content = {"steps": self.notes, "approved": self.approved}
        base = config_text(self.bench.base)
        write_json(self.path, COMMISSIONING, content, error=CellError)  # it makes the folder
        write_text(self.bench.folder / BASE_NAME, base, error=CellError, what="first config")
        self._fill_bench()

    def _fill_bench(self) -> None:
        every = self.notes.values()
        self.bench.settings = {k: v for notes in every for k, v in notes.settings.items()}
        self.bench.values = {key: notes.values for key, notes in self.notes.items()}


RESUME = "The findings are kept; the same command without --redo continues with this step"
"""How a person resumes a commissioning that was left."""


def leave(why: str) -> NoReturn:
    """Raise `WizardAborted` with instructions to resume."""
    raise WizardAborted(f"left: {why}. {RESUME}")


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
