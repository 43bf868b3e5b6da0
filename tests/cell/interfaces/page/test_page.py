"""The page in a browser, on a server with any state."""

import re
from collections.abc import Callable
from typing import Any

from tests.cell.interfaces.conftest import until
from tests.cell.interfaces.page.fake_cell import FakeCell

EVIL = '<img src=x onerror="window.evil=1">'
LAST = 'document.querySelector("%s").textContent'


def text(page: Any, selector: str) -> str:
    return str(page.text_content(selector)).strip()


def becomes(page: Any, selector: str, wanted: str) -> None:
    """Wait until an element shows a text; a regular expression."""
    from playwright.sync_api import expect

    expect(page.locator(selector)).to_have_text(re.compile(wanted), timeout=10_000)


def test_the_page_shows_the_state_and_commands_once(
    open_page: Callable[..., Any], cell: FakeCell
) -> None:
    cell.state = cell.idle()
    page = open_page()
    becomes(page, "#state", "Ready")
    becomes(page, "#held_name", "^nut$")
    assert "#token" not in page.url
    becomes(page, "#do_identify", "take command first")
    page.click("#do_identify", force=True)
    assert not cell.sent("POST", "jobs")
    page.click("#command")
    becomes(page, "#commander", "This page")
    becomes(page, "#do_identify", "name what is there")
    page.select_option("#keep", "always")
    page.click("#do_identify")
    until(lambda: cell.sent("POST", "jobs"))
    assert cell.sent("POST", "jobs") == [
        {"goal": {"task": "identify", "keep": "always"}, "lease": 1, "job": 13}
    ]
    page.keyboard.press("Escape")
    until(lambda: cell.sent("POST", "hold"))
    height, width = page.evaluate(
        "[document.documentElement.scrollHeight, document.documentElement.scrollWidth]"
    )
    assert (height, width) == (900, 1400)
