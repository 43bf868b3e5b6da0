"""The commissioning wizard behind the web interface, without a browser."""

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.checks.findings import Finding, ProposedChange
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Choice, Dialog, Engine, NumberRange, Question, StepFailed
from cell.commissioning.figures import curves, pads
from cell.commissioning.record import RECORD_NAME, write_record
from cell.config.serve import ServeConfig
from cell.errors import NotInCommand
from cell.interfaces.wizard import Wizard, WizardServer
from tactile.layout import paper_layout
from tests.cell.commissioning.test_engine import REAL, Asking
from tests.cell.interfaces.hosts import Client
from tests.waiting import until

WRITES = tuple(
    ProposedChange(
        where=f"servo {number}",
        what="Baud Rate (8)",
        before="57,600 bit/s",
        after="1,000,000 bit/s",
        undo="commission --restore",
    )
    for number in (1, 2)
)
LAYOUT = paper_layout()


@dataclass
class Ports(Asking):
    """A step with choices, which may fail, or end the wizard."""

    key: str = "ports"
    title: str = "Ports"
    purpose: str = "Finds the serial port of the servos. Nothing moves."
    settings: dict[str, Any] = field(default_factory=lambda: dict(REAL))
    mistakes: int = 0
    wrong: int = 0

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        if self.wrong:
            self.wrong -= 1
            raise StepFailed("No adapter is plugged in.")
        if self.mistakes:
            self.mistakes -= 1
            raise RuntimeError("this step has a mistake")
        names = ("/dev/ttyUSB0", "/dev/serial/by-id/usb-FTDI_USB__-__Serial_Converter_FT1-if00")
        choices = tuple(
            Choice(key=str(n), text=name, picture="linkage-pinion") for n, name in enumerate(names)
        )
        question = Question(
            key="ports.which", text="Which port leads to the servos?", choices=choices, default="0"
        )
        notes.fact(f"The servos are at {names[int(dialog.ask(question))]}.")
        notes.settings |= self.settings


@dataclass
class Moving(Asking):
    """A step that writes, watches a hand, moves until it is stopped or done, and asks a number."""

    key: str = "fingers"
    title: str = "Directions, zero and ends"
    purpose: str = "Finds which way each finger opens. Moves both fingers with the least current."
    needs: tuple[str, ...] = ("ports",)
    limp: bool = False
    go: threading.Event = field(default_factory=threading.Event)

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        dialog.approve(WRITES)
        dialog.say("Both servos answer at 1,000,000 bit/s.")
        angles = iter(range(10_000))
        dialog.ask(
            Question(
                key="fingers.open",
                text="Open both fingers by hand.",
                choices=(Choice(key="done", text="they are open"),),
                default="done",
            ),
            watch=lambda: f"servo 1: {next(angles) / 10:.1f} deg, servo 2: 12.0 deg",
        )
        try:
            while not self.go.wait(0.02):
                dialog.live("opening", "12.3 mm")
                dialog.live("current", "0.11 A")
        finally:
            self.limp = True
        block = Question(
            key="fingers.block",
            text="Thickness of the block between the pads?",
            number=NumberRange(lowest=1.0, highest=40.0, unit="mm"),
            default=10.0,
        )
        thick = float(dialog.ask(block))
        t_s = np.linspace(0.0, 2.0, 200)
        measured = 1.0 - np.exp(-t_s)
        notes.fact(f"A block of {thick:g} mm closes the fingers.")
        notes.warn("Finger 1 is a spline off.")
        notes.figures |= {
            "ramp": curves(
                "Ramp",
                t_s,
                {"asked": t_s / 2, "measured": measured},
                x_label="time / s",
                y_label="force / N",
            ),
            "noise": pads("Noise", LAYOUT, np.arange(LAYOUT.n_taxels) / 100, unit="counts"),
        }


class Page(Client):
    """A page: HTTP with the token, and the lease."""

    lease = 0

    def tell(self, path: str, **body: Any) -> int:
        """Command under the lease; return the status."""
        return self.ask("POST", f"/api/{path}", {"lease": self.lease, **body})[0]

    def state(self) -> dict[str, Any]:
        return self.get("/api/state")

    def becomes(self, phase: str) -> dict[str, Any]:
        until(lambda: self.state()["phase"] == phase)
        return self.state()

    def answer(self, value: Any) -> int:
        return self.tell("answer", asked_id=self.state()["asked_id"], value=value)

    def acquire(self) -> None:
        self.lease = self.post("/api/lease", name="page")["lease"]


@pytest.fixture
def walk() -> list[Any]:
    """Steps of the wizard."""
    return [Ports(), Moving()]


@pytest.fixture
def wizard(tmp_path: Path, walk: list[Any]) -> Iterator[Wizard]:
    """A wizard in a folder of its own."""
    serve = ServeConfig(http_port=0, lease_timeout_s=30.0)
    made = Wizard(Engine(walk, Bench(tmp_path), finish=write_record), serve)
    yield made
    made.close()


@pytest.fixture
def client(wizard: Wizard) -> Iterator[Page]:
    """A page on the interface of the wizard, in command."""
    interface = WizardServer(wizard)
    page = Page({"http_port": interface.port, "token": interface.token})
    page.acquire()
    yield page
    interface.close()


@pytest.fixture
def asked(client: Page) -> Callable[[Any], None]:
    """Return what answers the next question."""

    def answer(value: Any) -> None:
        until(lambda: client.state()["phase"] in ("asking", "approving"))
        assert client.answer(value) == 200

    return answer


def test_the_whole_way_left_once_and_taken_up_again(client, walk, tmp_path, asked) -> None:
    assert client.tell("run") == 200
    state = client.becomes("asking")
    assert state["question"]["text"] == "Which port leads to the servos?"
    asked("0")
    assert [w["where"] for w in client.becomes("approving")["writes"]] == ["servo 1", "servo 2"]
    asked(False)
    state = client.becomes("left")
    assert "nothing was written or moved" in state["error"]["text"]
    assert [step["status"] for step in state["steps"]] == ["pass", ""]

    assert client.tell("run") == 200
    asked(True)
    until(lambda: "servo 1: " in client.state()["live"].get("", ""))
    assert client.state()["said"] == ["Both servos answer at 1,000,000 bit/s."]
    asked("done")
    until(lambda: client.state()["live"].get("opening") == "12.3 mm")
    walk[1].go.set()
    until(lambda: (client.state()["question"] or {}).get("number"))
    until(lambda: client.state()["phase"] == "asking")
    for wrong in (0.5, 41, "ten", True):
        answer = {"asked_id": client.state()["asked_id"], "value": wrong, "lease": client.lease}
        status, found = client.ask("POST", "/api/answer", answer)
        assert (status, "from 1 to 40 mm" in found["error"]) == (422, True), wrong
    asked(10)
    state = client.becomes("finished")
    assert [step["status"] for step in state["steps"]] == ["pass", "warn"]
    assert str(tmp_path / RECORD_NAME) in state["files"]
    assert state["steps"][1]["figures"] == {"ramp": "Ramp", "noise": "Noise"}
    for name in ("ramp", "noise"):
        status, picture = client.ask("GET", f"/api/steps/fingers/figures/{name}")
        assert status == 200
        assert picture.startswith(b"<svg")
    assert client.ask("GET", "/api/steps/fingers/figures/none")[0] == 404
    assert b"A block of 10 mm" in client.ask("GET", "/api/record")[1]


def test_anybody_stops_a_motion_without_token_and_lease(client, walk, asked) -> None:
    client.tell("run")
    for value in ("1", True, "done"):
        asked(value)
    until(lambda: "opening" in client.state()["live"])
    client.token = "wrong-token"
    assert client.ask("POST", "/api/hold?name=another")[0] == 200
    assert client.ask("GET", "/api/state")[0] == 401
    until(lambda: walk[1].limp)


def test_a_person_who_falls_silent_ends_a_motion_and_no_question(
    client, wizard, walk, asked
) -> None:
    client.tell("run")
    client.becomes("asking")
    wizard.lease.give_up(client.lease)
    assert client.state()["phase"] == "asking"
    assert client.tell("answer", asked_id=1, value="0") == 403
    client.acquire()
    for value in ("0", True, "done"):
        asked(value)
    until(lambda: "opening" in client.state()["live"])
    wizard.lease.give_up(client.lease)
    state = client.becomes("left")
    assert "nobody is in command" in state["error"]["text"]
    assert walk[1].limp


def test_only_what_is_offered_is_an_answer(client, walk) -> None:
    client.tell("run")
    client.becomes("asking")
    for wrong in ("7", 0, True, ""):
        assert client.answer(wrong) == 422, wrong
    assert client.tell("answer", asked_id=99, value="0") == 422
    assert client.tell("run") == 422
    assert client.tell("redo", key="ports") == 422
    client.lease += 1
    assert client.answer("0") == 403


def test_what_ends_the_wizard_is_named_and_the_step_is_taken_up_again(client, walk) -> None:
    walk[0].mistakes = 1
    client.tell("run")
    state = client.becomes("failed")
    assert state["error"]["text"] == "unexpected error (RuntimeError): this step has a mistake"
    assert state["error"]["number"] > 0
    client.tell("run")
    assert client.becomes("asking")["error"] is None


def test_a_step_is_done_again_with_those_that_need_it(client, walk, asked) -> None:
    walk[1].go.set()
    client.tell("run")
    for value in ("0", True, "done", 10.0):
        asked(value)
    client.becomes("finished")
    found = client.ask("POST", "/api/redo", {"lease": client.lease, "key": "ports"})
    assert found == (200, {"steps": ["ports", "fingers"]})
    assert [step["status"] for step in client.state()["steps"]] == ["", ""]
    assert client.tell("redo", key="wheels") == 500


def test_the_end_of_the_program_ends_the_step(wizard) -> None:
    lease = wizard.lease.acquire("page")
    wizard.run(lease)
    until(lambda: wizard.state()["phase"] == "asking")
    wizard.close()
    assert not wizard.running
    with pytest.raises(NotInCommand):
        wizard.lease.alive(lease + 1)


@pytest.mark.long
def test_the_command_opens_the_page_until_it_is_ended(tmp_path) -> None:
    program = Path(sys.executable).with_name("tactile-cell")
    command = [str(program), "commission", str(tmp_path), "--page", "--http", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        found = json.loads(process.stdout.readline())
        state = Client(found).get("/api/state")
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 1  # not all steps are done
    assert state["phase"] == "ready"
    assert state["steps"][0]["key"] == "ports"
