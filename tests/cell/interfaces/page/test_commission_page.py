"""The commissioning wizard in a browser: the main way, left and taken up again."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import CONFIG_NAME, Engine, Question
from cell.commissioning.record import RECORD_NAME, write_record
from cell.config.file import load_config
from cell.config.serve import ServeConfig
from cell.interfaces.wizard import Wizard, WizardDoor
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import NoiseModel
from tactile.layout import pinch_layout
from tests.cell.commissioning.hands import Person
from tests.cell.commissioning.script import SimulatedLines
from tests.cell.commissioning.test_walk import PADS, SERVOS, brisk_steps
from tests.cell.interfaces.conftest import until
from tests.cell.interfaces.page.test_page import OpenPage, becomes, fits
from tests.cell.interfaces.test_wizard import Moving, Ports

pytestmark = pytest.mark.long


@pytest.fixture
def walk() -> list[Any]:
    """Steps of the wizard."""
    return [Ports(), Moving()]


@pytest.fixture
def address(tmp_path: Path, walk: list[Any]) -> Iterator[str]:
    """Address of a wizard's page, with its token."""
    serve = ServeConfig(http_port=0)
    wizard = Wizard(Engine(walk, Bench(tmp_path), finish=write_record), serve)
    door = WizardDoor(wizard)
    yield f"http://127.0.0.1:{door.port}/#token={door.token}"
    wizard.close()
    door.close()


def first_motion(page: Any) -> None:
    """Go from the start to the first motion."""
    page.click("#run[aria-disabled=false]")
    becomes(page, "#question_text", "Which port leads to the servos")
    page.click("#question_choices button >> nth=1")
    becomes(page, "#writes li:first-child .change", "57,600 bit/s → 1,000,000 bit/s")
    page.click("#approve")
    becomes(page, "#question_text", "Open both fingers by hand")
    becomes(page, "#now_live dd", "servo 1: [1-9]")  # runs on while nobody answers
    page.click("#question_choices button")
    becomes(page, "#now_live", "opening.*12.3 mm")


def test_a_cell_is_commissioned_left_and_taken_up_again(
    open_page: OpenPage, address: str, walk: list[Any], tmp_path: Path
) -> None:
    page = open_page(address)
    becomes(page, "#run", "take command first")
    page.click("#command")
    walk[0].wrong = 1
    page.click("#run[aria-disabled=false]")
    becomes(page, "#now_said", "No adapter is plugged in")
    page.click("text=leave; what was found is kept")
    first_motion(page)
    page.keyboard.press("Escape")
    becomes(page, "#state", "^Left$")
    becomes(page, "#now_error", "stopped by 127.0.0.1")
    assert walk[1].limp
    page.reload()
    becomes(page, "#run", "Go on")
    page.click("#run[aria-disabled=false]")
    becomes(page, "#state", "Waits for approval")
    page.click("#refuse")
    becomes(page, "#now_error", "none of them was done")
    walk[1].go.set()
    page.click("#run")
    page.click("#approve")
    page.click("#question_choices button")
    becomes(page, "#question_range", "1 to 40 mm")
    page.fill("#question_value", "50")
    page.click("#question_send")
    assert page.text_content("#state") == "Waits for you"  # the browser holds it back
    page.fill("#question_value", "12.5")
    page.click("#question_send")
    becomes(page, "#state", "Commissioned")
    becomes(page, "#files", "commissioning.html")
    page.click("#steps summary >> nth=1")
    becomes(page, "#steps li:nth-child(2)", "A block of 12.5 mm")
    drawn = "images => images.filter(image => image.naturalWidth).length"
    until(lambda: page.locator("#steps img").evaluate_all(drawn) == 2)
    with page.expect_download() as saved:
        page.click("#record")
    assert "A block of 12.5 mm" in Path(saved.value.path()).read_text("utf-8")
    page.click("text=Do this step again")
    page.click("#sure_yes")
    becomes(page, "#steps li:nth-child(2) summary", "open")
    assert fits(page)


def test_a_second_page_stops_a_motion_and_a_narrow_german_one_has_all(
    open_page: OpenPage, address: str, walk: list[Any]
) -> None:
    page = open_page(address, command=True)
    other = open_page(address, wide=False, locale="de-DE")
    walk[0].wrong = 1
    page.click("#run[aria-disabled=false]")
    # A sentence with figures is German there; one that has no translation says that it is English.
    becomes(other, "#question_text", "^Anschlüsse ist fehlgeschlagen. Beheben Sie es")
    becomes(other, "#question_choices", "Gefundenes bleibt erhalten")
    becomes(other, "#now_said li", "No adapter is plugged in")
    languages = [other.get_attribute(i, "lang") for i in ("#question_text", "#now_said span")]
    assert languages == ["de", "en"]
    page.click("text=leave; what was found is kept")
    first_motion(page)
    becomes(other, "#state", "Arbeitet")
    becomes(other, "#leave", "erst Kommando nehmen")
    assert fits(other)
    other.click("#hold")
    for one, word in ((page, "^Left$"), (other, "Unterbrochen")):
        becomes(one, "#state", word)
    until(lambda: walk[1].limp)


def test_a_closed_page_ends_a_motion(
    open_page: OpenPage, address: str, walk: list[Any], browser: Callable[..., Any]
) -> None:
    page = open_page(address, command=True)
    first_motion(page)
    page.close()
    until(lambda: walk[1].limp)


READ = """() => {
  const text = (id) => document.getElementById(id).textContent;
  const shown = (id) => !document.getElementById(id).hidden;
  return {
    state: text("state"), question: shown("question") ? text("question_text") : "",
    choices: document.querySelectorAll("#question_choices button").length,
    id: Number(document.getElementById("main").dataset.asked),
  };
}"""
"""What a person reads on the page."""


class HandledWizard(Wizard):
    """The wizard on a simulated cell in virtual time, whose hands act before the page is asked."""

    def __init__(self, engine: Engine, person: Person) -> None:
        super().__init__(engine, ServeConfig(http_port=0))
        self._script = person.script
        self.wanted: dict[str, str | float] = {}

    def say(self, text: str) -> None:
        self._script.said.append(text)
        super().say(text)

    def live(self, name: str, value_text: str) -> None:
        self._script.moment()
        super().live(name, value_text)

    def ask(self, question: Question, *, watch: Callable[[], str] | None = None) -> str | float:
        answer = self._script.ask(question, watch=watch)
        keys = [choice.key for choice in question.choices or ()]
        self.wanted[question.text] = keys.index(str(answer)) if answer in keys else answer
        return super().ask(question, watch=watch)


def meet(page: Any, wizard: HandledWizard, until_asked: str = "$^") -> str:
    """Answer until a question matches, or no step runs any more; return the state shown."""
    end_s = time.monotonic() + 120.0
    done = 0
    while time.monotonic() < end_s:
        page.wait_for_timeout(50)
        asked_id, seen = wizard.state()["asked_id"], page.evaluate(READ)
        if asked_id == done or seen["id"] != asked_id:
            if seen["state"] in ("Commissioned", "Step failed", "Left"):
                return str(seen["state"])
            continue
        question = seen["question"]
        if seen["state"] == "Waits for approval":
            page.click("#approve")
            done = asked_id
        elif seen["state"] == "Waits for you" and question:
            if re.search(until_asked, question):
                return str(seen["state"])
            answer = wizard.wanted[question]
            if seen["choices"]:
                page.click(f"#question_choices button >> nth={answer}")
            else:
                page.fill("#question_value", f"{answer}")
                page.click("#question_send")
            done = asked_id
    raise AssertionError(f"no end: {page.evaluate(READ)}")


def test_a_cell_of_wrong_hardware_is_brought_up_with_three_interruptions(
    open_page: OpenPage, tmp_path: Path
) -> None:
    settings = SimulatorSettings(
        layout=pinch_layout(),
        noise=NoiseModel(level=0.4),
        faults=(*SERVOS, *PADS),
        aperture_m=0.03,
    )
    given = {"tactile.interface": "socketcan", "tactile.channel": "can0"}
    with SimulatedCell(settings) as cell:
        bench = Bench(tmp_path, SimulatedLines(cell), given=given)
        engine = Engine(brisk_steps(), bench, finish=write_record)
        wizard = HandledWizard(engine, Person(cell))
        door = WizardDoor(wizard)
        try:
            page = open_page(f"http://127.0.0.1:{door.port}/#token={door.token}", command=True)
            # Left, stopped, and the page loaded anew: each time it goes on there.
            for at, leave in (("one finger by hand", "#leave"), ("Load 2 of 3", "Escape")):
                page.click("#run")
                meet(page, wizard, at)
                page.click(leave) if leave == "#leave" else page.keyboard.press(leave)
                becomes(page, "#state", "^Left$")
            page.click("#run")
            meet(page, wizard, "With which force")
            page.reload()
            becomes(page, "#state", "Waits for you")
            assert meet(page, wizard) == "Commissioned"
        finally:
            wizard.close()
            door.close()
    config = load_config(tmp_path / CONFIG_NAME)
    assert [servo.direction for servo in config.gripper.servos] == [1, -1]
    assert len(config.tactile.mounting) == 2
    found = bench.found["first_force"]["asked_held_peak_n"]
    assert [one[1] for one in found] == [pytest.approx(1.0, abs=0.2), pytest.approx(4.0, abs=0.3)]
    record = (tmp_path / RECORD_NAME).read_text("utf-8")
    for named in ("The pads of the two fingers are exchanged", "its zero is +16", "is dead"):
        assert named in record
