"""A browser on the machine, a server with any state, and pages on it."""

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from cell.control.part import Part
from cell.runtime.goals import Goal
from cell.service.service import Service, state_values
from gripper.errors import PartSlipped
from recognition.recognizer import UNKNOWN
from tests.cell.served import Served

BEFORE = ("nut", "bolt", "nut", UNKNOWN, "bolt", "nut", "pin", "nut", "nut", "bolt", "nut", "nut")
"""Parts that were named before a test begins."""
TEACHING: dict[str, Any] = {
    "task": "teach", "label": "washer", "grasps": 6, "missed": 1, "of": 10,
    "each": [{"force_n": 3.0 + i, "opening_mm": 2.1, "size_mm": 2.0} for i in range(6)],
}  # fmt: skip
SORTING: dict[str, Any] = {
    "task": "sort", "of": 40, "parts": 13, "n_rejected": 1, "n_missed": 0,
    "places": {"tray A": 7, "tray B": 4, "box": 1, "rejects": 1},
}  # fmt: skip


SHORT_LEASE_S = 2.0
"""Time-out of a lease: the page renews it four times as often."""


def address(served: Served) -> str:
    """Return the address of the page as `serve` prints it."""
    interfaces = served.interfaces
    return f"http://127.0.0.1:{interfaces['http_port']}/#token={interfaces['token']}"


class FakeCell:
    """A served stub that is brought into any state."""

    def __init__(self, served: Served, patch: pytest.MonkeyPatch) -> None:
        self.changes: dict[str, Any] = {}
        """What is shown in the place of the state's own values."""
        self.holds: list[str] = []
        """Who has held."""
        self.sends = threading.Event()
        self.sends.set()
        self.n_messages = 0
        self.info: dict[str, Any] = {
            "name": "Cell 3", "places": ["tray A", "tray B", "box", "rejects"],
        }  # fmt: skip
        """What is shown in the place of the plugin's own values."""
        self.served = served
        self.plugin: Any = served.plugin
        plain_info = self.plugin.info
        self.plugin.info = lambda: plain_info() | self.info
        self.plugin.model.taught = {
            label: {"n_grasps": 20, "shape": shape, "size_mm": 6.4}
            for label, shape in (("bolt", "cylinder"), ("nut", "flat"), ("pin", "cylinder"))
        }
        self.plugin.levels |= {
            "can": {"level": "ok", "frames": 182000, "lost": 0, "age_s": 0.012},
            "loop": {"level": "ok", "periods": 120000, "late": 0, "p99_ms": 5.3},
            "drift": {"level": "ok", "gain": 1.01, "opening_mm": 0.02},
            "recording": {"level": "ok", "path": "out/serve/recording.mcap", "text": ""},
        }
        self.service: Any = served.service
        self._stop, self.service.stop = self.service.stop, self._hold
        patch.setattr("cell.interfaces.web.state_values", self._values)
        for label in BEFORE:
            self._name(label)
        self.url = address(served)

    @property
    def state(self) -> dict[str, Any]:
        """What is shown now."""
        return state_values(self.service) | self.changes

    @property
    def asked(self) -> list[tuple[str, Any]]:
        """What the page has asked for: a task with the fields that it has set, or with a flag."""
        return [
            (one.task, one.model_dump(exclude_defaults=True)) if isinstance(one, Goal) else one
            for one in self.plugin.asked
        ]

    def given(self, task: str) -> list[Any]:
        """Return what was given with each job of a task or command."""
        return [given for one, given in self.asked if one == task]

    # -- states ----------------------------------------------------------------------------------

    def idle(self) -> None:
        """Ready, after identifications."""
        self.plugin.ready()

    def working(self) -> None:
        """The second grasp of an identification."""
        progress = {"grasps": 1, "of": 4, "best": "nut", "probability": 0.63}
        self._begin({"task": "identify", "present": "nut"}, progress)

    def named(self, label: str = "nut") -> None:
        """A part is named and kept."""
        self._name(label, keep="always")

    def unknown(self) -> None:
        """A part that was never taught is kept."""
        self.named(UNKNOWN)

    def faulted(self) -> None:
        """A fault that is latched, with a part in the grip."""
        self.named()
        self.plugin.fail(PartSlipped("the centre of force moved 3.1 mm, limit 2.0 mm"))

    def teaching(self) -> None:
        """A washer is taught."""
        self._begin({"task": "teach", "label": "washer"}, TEACHING)

    def sorting(self) -> None:
        """A sort, the fourteenth part."""
        self._begin({"task": "sort", "parts": 40}, SORTING)
        self.plugin.report(Part(label="nut", place="tray A"))

    def _name(self, label: str, **fields: Any) -> None:
        self.plugin.ready()
        self.plugin._tasks.finds = label
        self._start({"task": "identify", "present": "nut"} | fields)
        self.plugin._tasks.finds = ""

    def _begin(self, goal: dict[str, Any], progress: dict[str, Any]) -> None:
        self.plugin.ready()
        self.plugin.pause()
        self._start(goal)
        self.plugin.report(**progress)

    def _start(self, goal: dict[str, Any]) -> None:
        """Start a job that the page has not asked for, under whatever lease there is."""
        lease = self.service.lease.number
        self.service.start(lease or self.service.lease.acquire("PLC"), goal)
        del self.plugin.asked[-1]
        if not lease:
            self.service.lease.give_up(self.service.lease.number)

    # -- the service -----------------------------------------------------------------------------

    def _values(self, _service: Service) -> dict[str, Any]:
        assert self.sends.wait(60.0)
        self.n_messages += 1
        return self.state

    def _hold(self, reason: str) -> None:
        if reason.startswith("by "):  # a client's: the end of the lease of a job here stops none
            self.holds.append(reason)
            self._stop(reason)


CHROMIUM = Path("/usr/bin/chromium")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium of the system; for a module alone: its event loop is in the way of others."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    if not CHROMIUM.exists():
        pytest.skip(f"{CHROMIUM} is not there")
    with playwright.sync_playwright() as started:
        flags = ["--no-sandbox", "--disable-gpu"]
        chromium = started.chromium.launch(executable_path=str(CHROMIUM), args=flags)
        yield chromium
        chromium.close()


@pytest.fixture
def cell(serve: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeCell]:
    """A server whose state the test writes."""
    made = FakeCell(serve("http", serve__lease_timeout_s=SHORT_LEASE_S), monkeypatch)
    yield made
    made.sends.set()


@pytest.fixture
def open_page(browser: Any, request: pytest.FixtureRequest) -> Iterator[Callable[..., Any]]:
    """Return the opener of pages, at the test's ``cell`` where it has one.

    What a page writes to its console as an error fails the test.
    """
    errors: list[str] = []
    fake = request.getfixturevalue("cell") if "cell" in request.fixturenames else None
    with ExitStack() as undo:

        def make(
            url: str = "",
            *,
            wide: bool = True,
            command: bool = False,
            line: Any = None,
            **options: Any,
        ) -> Any:
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
            if line is not None:
                line.join(page)
                undo.callback(page.unroute_all, behavior="ignoreErrors")
            page.goto(url or fake.url)
            if command:
                page.click("#command")
                page.get_by_text("This page is in command").or_(
                    page.get_by_text("Diese Seite hat das Kommando")
                ).wait_for()
            return page

        yield make
    assert not errors, errors
