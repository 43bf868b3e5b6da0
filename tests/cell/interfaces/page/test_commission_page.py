"""The commissioning wizard in a browser: the main way, left and taken up again."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import CONFIG_NAME, Engine
from cell.commissioning.record import RECORD_NAME, write_record
from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.config.serve import ServeConfig
from cell.interfaces.wizard import Wizard, WizardDoor
from cell.pytest_plugin.process import CellProcess
from tests.cell.commissioning.test_terminal import RealHands
from tests.cell.commissioning.test_walk import brisk_steps
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


WRONG = (
    "servo1.factory",
    "servo2.factory",
    "servo2.turned",
    "servo1.horn=164",
    "unit.pads_swapped",
)
READ = """() => {
  const text = (id) => document.getElementById(id).textContent;
  const shown = (id) => !document.getElementById(id).hidden;
  return {
    state: text("state"), title: text("now_title"),
    question: shown("question") ? text("question_text") : "",
    choices: document.querySelectorAll("#question_choices button").length,
    said: [...document.querySelectorAll("#now_said li")].map((item) => item.textContent),
  };
}"""
"""What a person reads on the page."""


class PagePerson:
    """Does what the page asks for, with hands at a simulated cell in another process."""

    def __init__(self, page: Any, hands: RealHands) -> None:
        self._page, self._answers = page, hands.answers()
        self._title, self._read = "", 0

    def meet(self, until_asked: str = "$^", *, within_s: float = 240.0) -> str:
        """Answer until a question matches, or no step runs any more; return the state shown."""
        end_s = time.monotonic() + within_s
        while time.monotonic() < end_s:
            seen = self._page.evaluate(READ)
            self._hear(seen["title"], seen["said"])
            if seen["state"] == "Waits for approval":
                self._page.click("#approve")
            elif seen["state"] == "Waits for you" and seen["question"]:
                if re.search(until_asked, seen["question"]):
                    return str(seen["state"])
                assert "Mend it" not in seen["question"], seen
                self._answer(seen["question"], seen["choices"])
            elif seen["state"] in ("Commissioned", "Step failed", "Left"):
                return str(seen["state"])
            self._page.wait_for_timeout(100)
        raise AssertionError(f"no end after {within_s:g} s: {self._page.evaluate(READ)}")

    def _hear(self, title: str, said: list[str]) -> None:
        if title != self._title:
            self._title, self._read = title, 0
        for text in said[self._read :]:
            for pattern, act in self._answers.items():
                found = re.search(pattern[1:], text) if pattern.startswith("!") else None
                if found and callable(act):
                    act(found)
        self._read = len(said)

    def _answer(self, question: str, choices: int) -> None:
        typed: object = ""
        for pattern, answer in self._answers.items():
            found = None if pattern.startswith("!") else re.search(pattern, question)
            if found:
                typed = answer if isinstance(answer, str) else answer(found)
                break
        if choices:
            place = int(typed) - 1 if isinstance(typed, str) and typed else 0
            self._page.click(f"#question_choices button >> nth={place}")
        else:
            if typed:
                self._page.fill("#question_value", str(typed))
            self._page.click("#question_send")


@pytest.mark.timeout(400)
def test_a_cell_of_wrong_hardware_is_brought_up_with_three_interruptions(
    open_page: OpenPage, tmp_path: Path
) -> None:
    faults = {"simulator.faults": list(WRONG), "tactile.layout": "pinch"}
    cell = CellProcess(changed_config(CellConfig(), faults))
    given = {
        "gripper.port": cell.servo_port,
        "tactile.interface": cell.can_interface,
        "tactile.channel": cell.can_channel,
    }
    bench = Bench(tmp_path, given=given)
    wizard = Wizard(Engine(brisk_steps(), bench, finish=write_record), ServeConfig(http_port=0))
    door = WizardDoor(wizard)
    try:
        page = open_page(f"http://127.0.0.1:{door.port}/#token={door.token}", command=True)
        hands = RealHands(cell)
        # Left, stopped, and the page loaded anew: each time it goes on there.
        page.click("#run")
        PagePerson(page, hands).meet("Open one finger by hand")
        page.click("#leave")
        becomes(page, "#state", "^Left$")
        page.click("#run")
        PagePerson(page, hands).meet("Load 2 of 3")
        page.keyboard.press("Escape")
        becomes(page, "#state", "^Left$")
        hands.empty(None)
        page.click("#run")
        PagePerson(page, hands).meet("With which force")
        page.reload()
        becomes(page, "#state", "Waits for you")
        assert PagePerson(page, hands).meet() == "Commissioned"
    finally:
        wizard.close()
        door.close()
        cell.end()
    config = load_config(tmp_path / CONFIG_NAME)
    assert [servo.direction for servo in config.gripper.servos] == [1, -1]
    assert len(config.tactile.mounting) == 2
    found = bench.found["first_force"]["asked_held_peak_n"]
    assert [one[1] for one in found] == [pytest.approx(1.0, abs=0.3), pytest.approx(4.0, abs=0.4)]
    record = (tmp_path / RECORD_NAME).read_text("utf-8")
    assert "The pads of the two fingers are exchanged" in record
    assert "its zero is +16" in record
