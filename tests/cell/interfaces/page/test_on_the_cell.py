"""The page on the real interface: on a stub of the cell, and once on the simulated cell."""

import socket
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from cell.control.states import Command
from gripper.errors import PartSlipped
from tests.cell.interfaces.page.conftest import address
from tests.cell.interfaces.page.test_page import becomes, click, fits, press
from tests.waiting import until


class Line:
    """Passes bytes on to a port of this machine, from a port of its own."""

    def __init__(self, to: int) -> None:
        self.late = threading.Event()
        """Clear: each piece of an answer waits for `LATE_S`."""
        self.late.set()
        self.mute = False
        """Whether answers are lost on the way."""
        self._to, self._is_cut, self._links = to, False, set[socket.socket]()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """End all connections, and take none until `mend`."""
        self._is_cut = True
        for link in tuple(self._links):
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)

    def mend(self) -> None:
        self._is_cut = False

    def close(self) -> None:
        self.cut()
        self._listener.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._listener.close()
        until(lambda: not self._links)

    def _serve(self) -> None:
        with suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if self._is_cut:
                    near.close()
                    continue
                far = socket.create_connection(("127.0.0.1", self._to))
                self._links |= {near, far}
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=(*ends, near), daemon=True).start()

    def _pass(self, source: socket.socket, sink: socket.socket, near: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                if sink is near and self.mute:
                    continue
                if sink is near:
                    self.late.wait(LATE_S)
                sink.sendall(data)
        with suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)
        source.close()
        self._links.discard(source)


pytestmark = pytest.mark.long

SHORT_LEASE_S = 2.0
LATE_S = 1.5
"""Delay in s of a slow line."""


@pytest.fixture
def wire(served: Any) -> Iterator[Line]:
    made = Line(served.interfaces["http_port"])
    yield made
    made.close()


def test_a_part_is_named_kept_verified_and_let_go(served, open_page) -> None:
    page = open_page(address(served), command=True)
    page.select_option("#keep", "when_named")
    click(page, "#do_identify", "#state", "Part held")
    becomes(page, "#held_name", "ball")
    becomes(page, "#do_identify", "a part is held")
    click(page, "#do_verify", "#held_check", "Still the same part")
    press(page, "#do_release", 0.3)
    assert served.grip_n > 0.0
    press(page, "#do_release", 1.3)
    becomes(page, "#state", "Ready")
    assert served.grip_n == 0.0
    # What is gripped next has no name until it is identified.
    served.plugin.pause()
    page.click("#do_identify")
    until(lambda: served.plugin.job().outcome_number == 2)
    click(page, "#command", "#state", "On hold")
    becomes(page, "#held_when", "In the grip")
    becomes(page, "#held_name", "Not named")
    tasks = [one.task if hasattr(one, "task") else one[0] for one in served.plugin.asked]
    assert tasks == ["identify", "verify", Command.RELEASE, "identify"]


def test_the_way_out_of_a_fault_step_by_step(served, open_page) -> None:
    page = open_page(address(served), command=True)
    served.plugin.pause()
    click(page, "#do_grip", "#state", "Working")
    served.plugin.fail(PartSlipped("the centre of force moved 3.1 mm, limit 2.0 mm"))
    becomes(page, "#fault_title", "The held part slips")
    becomes(page, "#fault_number", "Fault 206")
    assert page.locator("#fault_steps li").evaluate_all(
        "steps => steps.map(step => step.dataset.step)"
    ) == ["look", "clear", "support_part", "release", "reset"]
    assert not page.is_visible("#do_identify")
    becomes(page, "[data-step=release] button", "clear the fault first")
    becomes(page, ".next p", "Acknowledge the fault")
    click(page, "[data-step=clear] button", "#state", "Reset needed")
    becomes(page, ".next p", "Release the part")
    assert served.grip_n > 0.0
    press(page, "[data-step=release] button", 0.3)
    assert served.grip_n > 0.0
    press(page, "[data-step=release] button", 1.3)
    until(lambda: served.grip_n == 0.0)
    becomes(page, ".next p", "Reset: devices are checked")
    click(page, "[data-step=reset] button", "#state", "Ready")
    assert not page.is_visible("#fault")
    assert page.is_visible("#do_identify")


def test_a_lost_lease_is_told_and_taken_anew(serve, open_page) -> None:
    served = serve("http", serve__lease_timeout_s=SHORT_LEASE_S)
    page = open_page(address(served), command=True)
    served.plugin.pause()
    click(page, "#do_grip", "#state", "Working")
    served.pass_lease()
    becomes(page, "#state", "On hold")
    becomes(page, "#said", "no longer in command")
    becomes(page, "#commander", "Nobody")
    becomes(page, "#do_release", "take command first")
    click(page, "#command", "#do_release", "the part may fall")


def test_command_is_taken_over_and_given_up(served, open_page) -> None:
    served.service.lease.acquire("PLC")
    page = open_page(address(served))
    becomes(page, "#commander", "In command: PLC")
    click(page, "#command", "#sure_text", "PLC is in command. Take over?")
    click(page, "#sure_no", "#commander", "In command: PLC")
    page.click("#command")
    click(page, "#sure_yes", "#commander", "This page")
    page.reload()
    becomes(page, "#commander", "This page")
    # The browser copies the storage of a page to its duplicate, as to a page that it opens.
    with page.context.expect_page() as opened:
        page.evaluate("() => void window.open(location.href)")
    twin = opened.value
    becomes(twin, "#commander", "In command: page-")
    becomes(twin, "#do_identify", "take command first")
    name = served.service.lease.name
    for again in (twin, page):
        again.reload()
        becomes(again, "#commander", "This page" if again is page else f"In command: {name}")
    page.goto("about:blank")
    page.go_back()
    becomes(page, "#commander", "This page")
    click(page, "#command", "#commander", "Nobody")
    becomes(twin, "#commander", "Nobody")


def test_a_cut_line_is_red_at_once_and_returns_by_itself(served, wire, open_page) -> None:
    page = open_page(address(served, wire.port), command=True)
    becomes(page, "#state", "Ready")
    wire.cut()
    becomes(page, "#state", "Not connected")
    assert page.get_attribute("#band", "data-level") == "bad"
    assert page.text_content("#felt_force") == "–"
    becomes(page, "#do_identify", "not connected")
    page.evaluate("window.same = true")
    served.plugin.pause()
    served.service.start(served.service.lease.number, {"task": "grip", "force_n": 3.0})
    wire.mend()
    becomes(page, "#state", "Working")
    becomes(page, "#commander", "This page")
    assert page.evaluate("window.same")
    assert len(served.plugin.asked) == 1


def test_a_command_whose_answer_is_lost_is_done_once(served, wire, open_page) -> None:
    page = open_page(address(served, wire.port), command=True)
    wire.mute = True
    page.click("#do_grip")
    until(lambda: served.plugin.asked)
    becomes(page, "#state", "Not connected")
    wire.mute = False
    becomes(page, "#state", "Part held")
    becomes(page, "#do_verify", "still the same part")
    assert len(served.plugin.asked) == 1


def test_a_slow_line_is_not_shown_as_live(served, wire, open_page) -> None:
    page = open_page(address(served, wire.port))
    becomes(page, "#state", "Ready")
    wire.late.clear()
    becomes(page, "#state", "Not connected")
    page.evaluate("window.came = 0")
    # It stays so while messages come, each too late.
    for _ in range(20):
        page.wait_for_timeout(100)
        assert page.text_content("#state") == "Not connected"
    wire.late.set()
    becomes(page, "#state", "Ready")


def test_a_trainer_sets_up_a_simulated_cell_in_the_drawer(serve, open_page) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    served = serve("http", cell={})
    world = served.plugin.cell.simulated.world
    page = open_page(address(served), wide=False)
    click(page, "#simulated", "#sim_taken", "each object in turn")
    becomes(page, "#sim_put", "take command first")
    click(page, "#command", "#sim_put", "for all jobs from now on")
    page.select_option("#sim_part", label="another shape")
    page.select_option("#sim_kind", label="box")
    page.locator("#sim_lengths [name=height]").fill("6")
    page.locator("#sim_pose [name=x_m]").fill("1.5")
    click(page, "#sim_put", "#sim_placed", "^box 16 × 10 × 6 mm$")
    assert world.placed[1].x_m == pytest.approx(1.5e-3)
    found = axe.run(page).response["violations"]
    assert not found, [(one["id"], one["nodes"][0]["html"]) for one in found]
    assert fits(page)
    page.select_option("#sim_fault", "servo1.overheat")
    becomes(page, "#sim_fault option:checked", "its internal temperature has this value")
    becomes(page, "#sim_meaning", r"^servo1\.overheat$")
    page.select_option("#sim_fault", "servo1.off")
    click(page, "#sim_begin", "#sim_running li span", "servo1.off")
    page.click("#sim_running button")
    page.wait_for_selector("#sim_running li", state="detached")
    page.click("#sim_reset")
    until(lambda: served.plugin.job().task == "simulation_reset")
    assert served.ended().error == ""
    becomes(page, "#sim_placed", "nothing")


def test_a_second_person_watches_by_the_link(served, open_page) -> None:
    page = open_page(address(served), wide=False)
    click(page, "#share_open", "#share_note", "set serve.listen to 0.0.0.0")
    found = served.interfaces
    link = page.get_attribute("#share_address", "href")
    assert link == address(served).replace(found["token"], found["view_token"])
    assert fits(page)
    second = open_page(link, wide=False)
    becomes(second, "#state", "Ready")
    becomes(second, "#view_only", "view only")
    becomes(second, "#do_identify", "this page only watches")
    assert not second.is_visible("#command")
    assert fits(second)
    page.click("#share_close")
    page.click("#command")
    served.plugin.pause()
    page.click("#do_grip")
    becomes(second, "#state", "Working")
    second.keyboard.press("Escape")
    becomes(page, "#state", "On hold")
    assert served.grip_n > 0.0
