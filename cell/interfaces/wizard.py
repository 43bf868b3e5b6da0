"""The commissioning wizard in a browser: its engine in a thread, the operator at the web interface.

Needs the extras ``serve`` and ``report``. The client with the lease answers; any client may stop.
A client that leaves, or is silent while a step works, ends the step like a refusal; an open
question waits.
"""

import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from enum import StrEnum
from importlib.metadata import version
from typing import Annotated, Any

from fastapi import HTTPException, Query, Request
from fastapi.responses import Response

from cell.checks.findings import Finding, ProposedChange
from cell.commissioning.engine import Dialog, Engine, Question, Step, WizardAborted
from cell.commissioning.figures import standalone_svg
from cell.commissioning.record import render_record
from cell.config.serve import ServeConfig
from cell.errors import RequestRefused
from cell.fault_catalogue import Refusal
from cell.interfaces.live_socket import LiveMessage
from cell.interfaces.web_server import LeasedBody, Paths, WebServer
from cell.plugin.lease import Lease

_WATCH_S = 0.1
"""Time in s between two readings of values that a person moves by hand."""
_WAIT_S = 0.25
"""Longest time in s between two checks whether a wait should end."""
_SAID_MAX = 30
"""Most texts of a step that the page keeps."""


class Phase(StrEnum):
    """Phase of the wizard."""

    READY = "ready"
    """Not begun."""
    WORKING = "working"
    ASKING = "asking"
    APPROVING = "approving"
    LEFT = "left"
    """Left by the operator; it can continue."""
    FAILED = "failed"
    """Ended by an error; it can continue."""
    FINISHED = "finished"


class Wizard(Dialog):
    """The wizard for the page; implements `cell.commissioning.engine.Dialog`.

    The thread of the engine calls the methods of a dialog; threads of the server call the others.
    The config contains the time-out of the lease.
    """

    def __init__(self, engine: Engine, config: ServeConfig) -> None:
        self.engine = engine
        self.config = config
        self._changed = threading.Condition()
        self.lease = Lease(
            config.lease_timeout_s,
            given=lambda _name: None,
            lost=self._lost,
            lock=self._changed,
        )
        self._thread: threading.Thread | None = None
        self._phase = Phase.READY
        self._step = ""
        self._said: list[str] = []
        self._live: dict[str, str] = {}
        self._asked_id = 0
        self._question: Question | None = None
        self._writes: tuple[ProposedChange, ...] = ()
        self._answer: str | float | bool | None = None
        self._leaving = ""
        self._refusal: Refusal | None = None
        self._files: tuple[str, ...] = ()

    # -- what clients do -----------------------------------------------------------------------

    def run(self, lease: int) -> None:
        """Start, or continue with the first open step.

        Raises NotInCommand as `cell.plugin.lease.Lease.alive`, like the other commands, and
        RequestRefused while a step runs.
        """
        with self._changed:
            self.lease.alive(lease)
            self._refuse_while_running()
            self._leaving, self._refusal, self._phase = "", None, Phase.WORKING
            self._thread = threading.Thread(target=self._run, name="wizard", daemon=True)
            self._thread.start()

    def answer(self, lease: int, asked_id: int, value: str | float | bool) -> None:
        """Answer the open question, or approve the waiting writes with true.

        Raises RequestRefused if this question is no longer open, or if the answer is not one of its
        choices.
        """
        with self._changed:
            self.lease.alive(lease)
            if asked_id != self._asked_id or self._phase not in (Phase.ASKING, Phase.APPROVING):
                raise RequestRefused(f"question {asked_id} is no longer open")
            if self._answer is not None:
                raise RequestRefused(f"question {asked_id} already has an answer")
            self._answer = value if self._question is None else _checked(self._question, value)
            self._phase = Phase.WORKING
            self._changed.notify_all()

    def leave(self, lease: int) -> None:
        """End the running step; earlier results are kept."""
        with self._changed:
            self.lease.alive(lease)
            self.stop("left by the person at the page")

    def stop(self, reason: str) -> None:
        """End the running step at its next check; needs no lease."""
        with self._changed:
            if self.running:
                self._leaving = reason
                self._changed.notify_all()

    def redo(self, lease: int, key: str) -> tuple[str, ...]:
        """Delete the results of a step and of all steps that need it; return their keys."""
        with self._changed:
            self.lease.alive(lease)
            self._refuse_while_running()
            self._phase, self._refusal = Phase.READY, None
            return self.engine.redo(key)

    @property
    def running(self) -> bool:
        """Whether a step runs or waits for an answer."""
        return self._thread is not None and self._thread.is_alive()

    def close(self) -> None:
        """End the running step and wait for its end."""
        self.stop("the program ends")
        if self._thread is not None:
            self._thread.join()

    def state(self) -> dict[str, Any]:
        """Return the state for the page, as plain data."""
        with self._changed:
            self.lease.check_expiry()
            question = self._question
            return {
                "time_s": time.time(),
                "commander": self.lease.name,
                "phase": self._phase.value,
                "step": self._step,
                "steps": [self._step_view(step) for step in self.engine.steps],
                "said": list(self._said),
                "live": dict(self._live),
                "asked_id": self._asked_id,
                "question": None if question is None else asdict(question),
                "writes": [asdict(write) for write in self._writes],
                "error": None if self._refusal is None else asdict(self._refusal),
                "files": list(self._files),
                "corrected": self.engine.corrected,
            }

    # -- the dialog, in the engine's thread ----------------------------------------------------

    def start_step(self, step: Step, number: int, count: int) -> None:
        """Show the step that begins."""
        with self._changed:
            self._look()
            self._step, self._said, self._live = step.key, [], {}

    def found(self, step: Step, finding: Finding) -> None:
        """Show the finding of a step: `state` contains the findings of the engine."""
        with self._changed:
            self._live = {}
            self._look()

    def say(self, text: str) -> None:
        """Show a text."""
        with self._changed:
            self._look()
            # A repeated text moves to the end, so that the page shows it once.
            self._said = [*(one for one in self._said if one != text), text][-_SAID_MAX:]

    def live(self, name: str, value_text: str) -> None:
        """Show a value instead of its previous one."""
        with self._changed:
            self._look()
            self._live[name] = value_text

    def ask(self, question: Question, *, watch: Callable[[], str] | None = None) -> str | float:
        """Wait for the answer of the page."""
        self._question = question
        try:
            answer = self._wait(Phase.ASKING, watch)
        finally:
            self._question = None
        assert isinstance(answer, str | float)
        return answer

    def approve(self, writes: Sequence[ProposedChange]) -> None:
        """Wait until the writes are approved."""
        self._writes = tuple(writes)
        try:
            if not self._wait(Phase.APPROVING):
                raise WizardAborted("the writes were refused; nothing was written or moved")
        finally:
            self._writes = ()

    def _wait(self, phase: Phase, watch: Callable[[], str] | None = None) -> str | float | bool:
        """Return the answer of the page; a watched value is shown with an empty name."""
        with self._changed:
            self._look()
            self._asked_id += 1
            self._answer, self._phase = None, phase
        try:
            while (answer := self._answer_so_far(_WAIT_S if watch is None else _WATCH_S)) is None:
                if watch is not None:
                    text = watch()
                    with self._changed:
                        self._live[""] = text
            return answer
        finally:
            with self._changed:
                self._phase = Phase.WORKING
                self._live.pop("", None)

    def _answer_so_far(self, wait_s: float) -> str | float | bool | None:
        with self._changed:
            self._look()
            if self._answer is None:
                self._changed.wait(wait_s)
            return self._answer

    def _look(self) -> None:
        self.lease.check_expiry()
        if self._leaving:
            reason, self._leaving = self._leaving, ""
            raise WizardAborted(reason)

    def _lost(self, reason: str) -> None:
        """End a working step, because it may move; a question waits for the next client."""
        if self._phase is Phase.WORKING and self.running:
            self._leaving = f"nobody is in command, {reason}"

    def _run(self) -> None:
        refusal: Refusal | None = None
        files: list[str] = []
        phase = Phase.FINISHED
        try:
            files = [str(path) for path in self.engine.run(self)]
        except WizardAborted as left:
            phase, refusal = Phase.LEFT, Refusal(text=str(left))
        except Exception as error:
            phase, refusal = Phase.FAILED, Refusal.of(error)
        with self._changed:
            self._phase, self._refusal, self._files = phase, refusal, tuple(files)
            self._step, self._live, self._leaving = "", {}, ""

    def _refuse_while_running(self) -> None:
        if self.running:
            raise RequestRefused("a step runs: answer it or leave it first")

    def _step_view(self, step: Step) -> dict[str, Any]:
        view = {
            "key": step.key,
            "title": step.title,
            "purpose": step.purpose,
            "needs": list(step.needs),
            "undo": step.undo,
        }
        finding = self.engine.findings.get(step.key)
        if finding is None:
            return view | {"status": "", "ended": "", "lines": [], "figures": {}}
        return view | {
            "status": finding.status.value,
            "ended": finding.ended,
            "lines": list(finding.lines),
            "figures": {name: figure["title"] for name, figure in finding.figures.items()},
        }


def _checked(question: Question, value: str | float | bool) -> str | float:
    """Return a valid answer to the question; raises RequestRefused for any other answer."""
    if question.choices is not None:
        keys = [choice.key for choice in question.choices]
        if value in keys:
            return str(value)
        raise RequestRefused(f"{value!r} is not a valid answer; use one of {', '.join(keys)}")
    if question.number is None:
        if isinstance(value, str):
            return value
        raise RequestRefused(f"{value!r} is not a text; send a string")
    low, high, unit = question.number.lowest, question.number.highest, question.number.unit
    if isinstance(value, int | float) and not isinstance(value, bool) and low <= value <= high:
        return float(value)
    raise RequestRefused(f"{value!r} is not a number from {low:g} to {high:g} {unit}")


class AnswerBody(LeasedBody):
    """Answer to the question with that id: a choice, a number, a text, or an approval."""

    asked_id: int
    value: bool | float | str


class RedoBody(LeasedBody):
    """A step to repeat."""

    key: str


class WizardServer(WebServer):
    """The wizard behind HTTP and WebSocket, below ``/api``.

    Raises OSError or ConfigError as `WebServer`.
    """

    def __init__(self, wizard: Wizard) -> None:
        self._wizard = wizard
        paths: Paths = (
            ("/info", "GET", self.info),
            ("/state", "GET", wizard.state),
            ("/steps/{key}/figures/{name}", "GET", self.figure),
            ("/record", "GET", self.record),
            ("/run", "POST", self.run),
            ("/answer", "POST", self.answer),
            ("/leave", "POST", self.leave),
            ("/redo", "POST", self.redo),
        )
        super().__init__(
            wizard.lease,
            wizard.config,
            lambda: LiveMessage(json.dumps(wizard.state(), allow_nan=False)),
            paths,
            page="commission.html",
        )

    def info(self) -> dict[str, Any]:
        """Version, folder of the cell, time-out of the lease."""
        folder = self._wizard.engine.bench.folder.resolve()
        return {
            "mode": "commission",
            "version": version("tactile-cell"),
            "name": folder.name,
            "folder": str(folder),
            "lease_timeout_s": self._wizard.config.lease_timeout_s,
        }

    def figure(self, key: str, name: str) -> Response:
        """Return a picture of a step, SVG."""
        finding = self._wizard.engine.findings.get(key)
        figure = None if finding is None else finding.figures.get(name)
        if figure is None:
            raise HTTPException(404, f"step {key!r:.40} has no figure {name!r:.40}")
        headers = {"X-Content-Type-Options": "nosniff", "Cache-Control": "no-store"}
        return Response(standalone_svg(figure), media_type="image/svg+xml", headers=headers)

    def record(self) -> Response:
        """Return the record of the results so far, HTML."""
        return Response(render_record(self._wizard.engine), media_type="text/html")

    def run(self, body: LeasedBody) -> dict[str, Any]:
        """Start, or continue with the first open step."""
        self._wizard.run(body.lease)
        return {}

    def answer(self, body: AnswerBody) -> dict[str, Any]:
        """Answer the open question; ``true`` approves the shown writes."""
        self._wizard.answer(body.lease, body.asked_id, body.value)
        return {}

    def leave(self, body: LeasedBody) -> dict[str, Any]:
        """End the running step; earlier results are kept."""
        self._wizard.leave(body.lease)
        return {}

    def redo(self, body: RedoBody) -> dict[str, Any]:
        """Delete the results of a step and of all steps that need it."""
        return {"steps": self._wizard.redo(body.lease, body.key)}

    def hold(
        self, request: Request, name: Annotated[str, Query(max_length=60)] = ""
    ) -> dict[str, Any]:
        """End the running step and its motion; needs no token and no lease."""
        host = "" if request.client is None else request.client.host
        self._wizard.stop(f"stopped by {f'{host} {name}'.strip()}")
        return {"state": self._wizard.state()["phase"]}
