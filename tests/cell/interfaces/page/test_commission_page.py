"""The commissioning wizard in a browser: the main way, left and taken up again."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Engine
from cell.commissioning.record import write_record
from cell.config.serve import ServeConfig
from cell.interfaces.wizard import Wizard, WizardServer
from tests.cell.commissioning.test_engine import Asking
from tests.cell.interfaces.page.test_page import becomes, click, fits
from tests.cell.interfaces.test_wizard import Moving, Ports
from tests.waiting import until

pytestmark = pytest.mark.long


@pytest.fixture
def walk() -> list[Any]:
    """Steps of the wizard."""
    return [Ports(), Moving(), Asking("name", settings={"gripper.baud_rate": 2_000_000})]


@pytest.fixture
def address(tmp_path: Path, walk: list[Any]) -> Iterator[str]:
    """Address of a wizard's page, with its token."""
    serve = ServeConfig(http_port=0)
    wizard = Wizard(Engine(walk, Bench(tmp_path), finish=write_record), serve)
    interface = WizardServer(wizard)
    yield f"http://127.0.0.1:{interface.port}/#token={interface.token}"
    wizard.close()
    interface.close()


def first_motion(page: Any) -> None:
    """Go from the start to the first motion."""
    click(page, "#run[aria-disabled=false]", "#question_text", "Which port leads to the servos")
    drawn = "images => images.filter(image => image.naturalWidth).length"
    until(lambda: page.locator("#question_choices img").evaluate_all(drawn) == 2)
    page.click("#question_choices button >> nth=1")
    becomes(page, "#writes li:first-child .change", "57,600 bit/s → 1,000,000 bit/s")
    click(page, "#approve", "#question_text", "Open both fingers by hand")
    becomes(page, "#now_live dd", "servo 1: [1-9]")  # runs on while nobody answers
    click(page, "#question_choices button", "#now_live", "opening.*12.3 mm")


def test_a_cell_is_commissioned_left_and_taken_up_again(open_page, address, walk, tmp_path) -> None:
    page = open_page(address)
    becomes(page, "#run", "take command first")
    page.click("#command")
    walk[0].wrong = 1
    click(page, "#run[aria-disabled=false]", "#now_said", "No adapter is plugged in")
    page.click("text=leave; the findings are kept")
    first_motion(page)
    page.keyboard.press("Escape")
    becomes(page, "#state", "^Left$")
    becomes(page, "#now_error", "stopped by 127.0.0.1")
    assert walk[1].limp
    page.reload()
    becomes(page, "#run", "Continue")
    click(page, "#run[aria-disabled=false]", "#state", "Waits for approval")
    click(page, "#refuse", "#now_error", "nothing was written or moved")
    walk[1].go.set()
    page.click("#run")
    page.click("#approve")
    click(page, "#question_choices button", "#question_range", "1 to 40 mm")
    page.fill("#question_value", "50")
    page.click("#question_send")
    assert page.text_content("#state") == "Waits for you"  # the browser holds it back
    page.fill("#question_value", "12.5")
    click(page, "#question_send", "#question_text", r"^\?$")
    page.reload()
    becomes(page, "#state", "Waits for you")
    page.fill("#question_value", "cube")
    click(page, "#question_send", "#state", "Commissioned")
    becomes(page, "#files", "commissioning.html")
    becomes(page, "#corrected", r"corrected\s*name was wrong")
    click(page, "#steps summary >> nth=1", "#steps li:nth-child(2)", "A block of 12.5 mm")
    drawn = "images => images.filter(image => image.naturalWidth).length"
    until(lambda: page.locator("#steps img").evaluate_all(drawn) == 2)
    with page.expect_download() as saved:
        page.click("#record")
    record = Path(saved.value.path()).read_text("utf-8")
    assert "A block of 12.5 mm" in record
    assert "name: cube" in record
    page.click("text=Repeat this step")
    click(page, "#sure_yes", "#steps li:nth-child(2) summary", "open")
    assert fits(page)


def test_a_second_page_stops_a_motion_and_a_narrow_german_one_has_all(
    open_page, address, walk
) -> None:
    page = open_page(address, command=True)
    other = open_page(address, wide=False, locale="de-DE")
    walk[0].wrong = 1
    page.click("#run[aria-disabled=false]")
    # A sentence with figures is German there; one that has no translation says that it is English.
    becomes(other, "#question_text", "^Anschlüsse ist fehlgeschlagen. Beheben Sie die Ursache")
    becomes(other, "#question_choices", "die Befunde bleiben erhalten")
    becomes(other, "#now_said li", "No adapter is plugged in")
    languages = [other.get_attribute(i, "lang") for i in ("#question_text", "#now_said span")]
    assert languages == ["de", "en"]
    page.click("text=leave; the findings are kept")
    first_motion(page)
    becomes(other, "#state", "Arbeitet")
    becomes(other, "#leave", "erst Kommando nehmen")
    assert fits(other)
    other.click("#hold")
    for one, word in ((page, "^Left$"), (other, "Unterbrochen")):
        becomes(one, "#state", word)
    until(lambda: walk[1].limp)


def test_a_closed_page_ends_a_motion(open_page, address, walk, browser) -> None:
    page = open_page(address, command=True)
    first_motion(page)
    page.close()
    until(lambda: walk[1].limp)
