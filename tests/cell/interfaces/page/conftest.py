"""A browser on the machine, a server with any state, and pages on it."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.cell.interfaces.page.fake_cell import FakeCell

CHROMIUM = Path("/usr/bin/chromium")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium of the system; for a module alone: its event loop is in the way of others."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.exists():
        pytest.skip(f"{CHROMIUM} is not there")
    with playwright.sync_playwright() as started:
        flags = ["--no-sandbox", "--disable-gpu"]
        found = started.chromium.launch(executable_path=str(CHROMIUM), args=flags)
        yield found
        found.close()


@pytest.fixture
def cell(serve: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCell]:
    """A server whose state the test writes."""
    made = FakeCell(serve("http"), monkeypatch)
    yield made
    made.sends.set()


@pytest.fixture
def open_page(browser: Any, request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    """Return the opener of pages, at the test's ``cell`` where it has one.

    What a page writes to its console as an error fails the test.
    """
    errors: list[str] = []
    shown = request.getfixturevalue("cell") if "cell" in request.fixturenames else None
    with ExitStack() as undo:

        def make(url: str = "", *, wide: bool = True, command: bool = False, **options: Any) -> Any:
            size = {"width": 1400, "height": 900} if wide else {"width": 420, "height": 900}
            context = browser.new_context(**{"viewport": size, "locale": "en-GB"} | options)
            undo.callback(context.close)
            page = context.new_page()
            page.set_default_timeout(30_000)
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on(
                "console",
                # Refusals and cut connections are wanted; the browser writes them down.
                lambda told: (
                    errors.append(told.text)
                    if told.type == "error"
                    and "Failed to load resource" not in told.text
                    and "WebSocket connection" not in told.text
                    else None
                ),
            )
            page.goto(url or shown.url)
            if command:
                page.click("#command")
                page.get_by_text("This page is in command").or_(
                    page.get_by_text("Diese Seite hat das Kommando")
                ).wait_for()
            return page

        yield make
    assert not errors, errors
