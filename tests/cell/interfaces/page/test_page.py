"""The page in a browser, on a server with any state."""

import json
import re
from typing import Any

import pytest

from cell.control.states import Command
from cell.hand.interface import LiveValues
from gripper.errors import PartSlipped
from tests.cell.interfaces.page.conftest import SHORT_LEASE_S, TEACHING, FakeCell, address
from tests.marks import LONG
from tests.waiting import until

EVIL = '<img src=x onerror="window.evil=1">'
STATES = ("idle", "working", "named", "unknown", "faulted", "teaching", "sorting")


@pytest.fixture
def page(open_page: Any) -> Any:
    return open_page()


def becomes(page: Any, selector: str, wanted: str) -> None:
    """Wait until an element shows a text, a regular expression."""
    from playwright.sync_api import expect

    # A space of a pattern is any: between number and unit it is one that does not break.
    pattern = re.compile(re.sub(r"\\? ", r"\\s", wanted))
    expect(page.locator(selector)).to_have_text(pattern, timeout=20_000)


def click(page: Any, button: str, selector: str, wanted: str) -> None:
    """Make one step of an operator: click, and wait until an element shows a text."""
    page.click(button)
    becomes(page, selector, wanted)


DRAWN = """Promise.race([
  new Promise((go) => requestAnimationFrame(() => requestAnimationFrame(() => go(true)))),
  new Promise((go) => setTimeout(() => go(false), 5000))])"""
"""Whether two frames were drawn. A browser without a screen may stop until a picture is wanted."""


def show(page: Any, cell: FakeCell, name: str) -> None:
    """Bring the cell into a state, and wait until the page shows it."""
    getattr(cell, name)()
    before = cell.n_messages
    until(lambda: cell.n_messages > before + 1)
    if not page.evaluate(DRAWN):
        page.screenshot()


def fits(page: Any) -> bool:
    """Whether nothing stands out of the window at the side."""
    return bool(page.evaluate("document.documentElement.scrollWidth <= innerWidth"))


WIDTHS = (360, 768, 999, 1000, 1366, 1600)
"""Widths at the limits of the style sheet, and between them."""
MORE_WIDTHS = (412, 600, 1024, 1100, 1200, 1280, 1920, 2560)
WRONG = """() => {
  const wrong = [];
  const name = (one) => one.id || one.className || one.tagName;
  const shown = (one) => one.checkVisibility() && !one.closest(".unseen");
  const { scrollWidth } = document.documentElement;
  if (scrollWidth > innerWidth) wrong.push(`the page is ${scrollWidth} px wide`);
  for (const parent of ["#band", "#main", ".commands", ".values"]) {
    const boxes = [...document.querySelector(parent).children].filter(shown)
      .map((one) => [name(one), one.getBoundingClientRect()]);
    boxes.forEach(([a, p], i) => boxes.slice(i + 1).forEach(([b, q]) => {
      const x = Math.min(p.right, q.right) - Math.max(p.left, q.left);
      const y = Math.min(p.bottom, q.bottom) - Math.max(p.top, q.top);
      if (x > 1 && y > 1) wrong.push(`${a} and ${b} overlap`);
    }));
  }
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (texts.nextNode()) {
    const { currentNode: node } = texts;
    const { parentElement: owner } = node;
    const found = (text) => wrong.push(`${name(owner)}: ${text}`);
    if (!shown(owner) || owner.closest("option, svg, dialog:not([open])")) continue;
    for (const word of node.data.matchAll(/[^\\s-]+/g)) {
      const range = document.createRange();
      range.setStart(node, word.index);
      range.setEnd(node, word.index + word[0].length);
      const rects = [...range.getClientRects()];
      if (rects.some((one) => one.top > rects[0].bottom - 2)) found(`${word[0]} is broken`);
      const outer = owner.closest("button, .card, .band, .health");
      const right = outer?.getBoundingClientRect().right ?? Infinity;
      if (rects.some((one) => one.right > right + 1)) found(`${word[0]} stands out`);
    }
  }
  return [...new Set(wrong)];
}"""
"""Texts for what overlaps, stands out, or is broken within a word."""


@pytest.mark.parametrize("locale", ["de-DE", LONG("en-US")])
@pytest.mark.parametrize("token", ["view_token", LONG("token")])
@pytest.mark.parametrize("widths", [WIDTHS, LONG(MORE_WIDTHS)])
def test_nothing_overlaps_or_breaks_at_any_width(open_page, cell, locale, token, widths) -> None:
    cell.named("dumbbell")
    url = cell.url.partition("token=")[0] + f"token={cell.served.interfaces[token]}"
    page = open_page(url, locale=locale, command=token == "token")
    becomes(page, "#cell", "Cell 3")
    for name in STATES:
        show(page, cell, name)
        for width in widths:
            page.set_viewport_size({"width": width, "height": 900})
            assert not page.evaluate(WRONG), (name, width)
    page.evaluate("document.querySelector('#left').style.width = '2000px'")
    assert page.evaluate(WRONG)


def test_a_narrow_page_shows_hold_and_the_answer_first(open_page, cell) -> None:
    cell.named()
    page = open_page(wide=False)
    becomes(page, "#held_name", "nut")
    hold, name, identify = (
        page.locator(one).bounding_box() for one in ("#hold", "#held_sure", "#do_identify")
    )
    assert hold["y"] < name["y"] < 500 < identify["y"]


HOLD_IN_FRONT = """() => {
  const hold = document.querySelector("#hold");
  const { left, top, width, height } = hold.getBoundingClientRect();
  return [0.1, 0.5, 0.9].every((share) =>
    hold.contains(document.elementFromPoint(left + share * width, top + share * height)));
}"""
"""Whether a click at the centre of Hold, and near two of its corners, goes to Hold."""


@pytest.mark.parametrize("size", [(390, 844), (844, 390), LONG((1000, 600)), LONG((1280, 720))])
def test_hold_is_in_front_of_all_wherever_the_page_is_scrolled(open_page, cell, size) -> None:
    page = open_page(viewport=dict(zip(("width", "height"), size, strict=True)))
    for name in ("idle", "faulted"):
        show(page, cell, name)
        for dialog in ("", "#grasp", "#simulation", "#share", "#sure"):
            if dialog:
                page.evaluate(f"document.querySelector('{dialog}').show()")
            for scroll_px in (0, 60, 150, 300, 600, 900, 9000):
                page.evaluate(f"scrollTo(0, {scroll_px})")
                assert page.evaluate(HOLD_IN_FRONT), (name, dialog, scroll_px)
            if dialog:
                page.evaluate(f"document.querySelector('{dialog}').close()")
    page.click("#hold")
    until(lambda: cell.holds)


def test_another_shape_is_remarked_only_with_another_size(open_page, cell) -> None:
    for taught in cell.plugin.model.taught.values():
        taught |= {"shape": "oval", "size_mm": 9.6}
    cell.named()
    page = open_page()
    becomes(page, "#held_size", r"^an oval of 9\.5 mm\s9\.0 to 10\.0 mm$")
    for taught in cell.plugin.model.taught.values():
        taught["size_mm"] = 6.4
    cell.plugin.model.revision += 1
    becomes(page, "#held_size", "The pads measure a sphere of 9.5 mm: name and shape do not match")
    assert page.locator("#held_shape ellipse.part").count() == 1
    # A part that was never taught has its shape and size, too.
    show(page, cell, "unknown")
    becomes(page, "#held_name", "Unknown")
    becomes(page, "#held_sure", "Never taught; measured as a sphere of 9.5 mm")
    assert page.locator("#strip .unknown").count() == 2
    assert page.locator("#held_shape .part").count() == 1


def press(page: Any, selector: str, seconds: float) -> None:
    """Press a button for so long; the time is that of a person."""
    page.hover(selector)
    page.mouse.down()
    page.wait_for_timeout(1e3 * seconds)
    page.mouse.up()


def test_the_page_shows_today_yesterday_the_week_and_what_is_confused(open_page, cell) -> None:
    sums = {"parts": 400, "rejected": 3, "missed": 0, "faults": 1}
    pairs = [
        {"held": EVIL, "named": "nut", "n": 4, "confirmed": True},
        {"held": "pin", "named": "bolt", "n": 2, "confirmed": False},
    ]
    cell.service.history.values = lambda: {
        "today": {"parts": 0}, "yesterday": sums, "week": sums | {"confused": pairs},
    }  # fmt: skip
    page = open_page()
    lost = r"400 \(Rejected 3, Faults 1\)"
    named = re.escape(f"Confused: {EVIL} → nut 4×, pin ≈ bolt 2×")
    becomes(page, "#days", rf"^today 0yesterday {lost}this week {lost}{named}$")
    page.set_viewport_size({"width": 1366, "height": 768})
    days = "document.querySelector('#days')"
    until(lambda: page.evaluate(f"{days}.scrollHeight <= {days}.clientHeight + 1"))
    assert fits(page)


def test_the_page_shows_the_state_and_commands_once(page, cell) -> None:
    becomes(page, "#state", "Ready")
    becomes(page, "#held_name", "^nut$")
    assert "token" not in page.url
    becomes(page, "#do_identify", "take command first")
    page.click("#do_identify", force=True)
    assert not cell.asked
    click(page, "#command", "#commander", "This page")
    becomes(page, "#do_identify", "name the part")
    page.select_option("#keep", "always")
    page.click("#do_identify")
    until(lambda: cell.asked)
    assert cell.asked == [("identify", {"keep": "always", "present": "ball"})]
    assert cell.state["job"]["number"] == 13
    page.click("#strip button >> nth=-1")
    page.keyboard.press("Escape")  # it holds, and closes what is open
    until(lambda: cell.holds)
    page.wait_for_selector("#grasp", state="hidden")
    page.click("#hold")
    until(lambda: len(cell.holds) == 2)
    heard_s = cell.service.lease._heard_s
    cell.served.clock.now_s += 1.0
    until(lambda: cell.service.lease._heard_s > heard_s)


def test_a_name_is_text_wherever_it_stands(open_page, cell) -> None:
    cell.named(EVIL)
    state, nearest = cell.state, {"runner_up": {"label": EVIL, "probability": 0.1}}
    answers = [
        answer | {"label": EVIL, "place": EVIL} | nearest for answer in state["shift"]["answers"]
    ]
    cell.changes = {
        "shift": state["shift"] | {"answers": answers, "counts": {EVIL: 3}},
        "job": state["job"] | {"task": EVIL, "progress": {"best": EVIL, "of": 3, "label": EVIL}},
        "held_by": [EVIL],
        "commander": EVIL,
    }
    cell.info |= {"name": EVIL, "places": [EVIL, "rejects"]}
    cell.plugin.model.taught = {EVIL: {"n_grasps": 3, "shape": EVIL, "size_mm": 3.0}}
    page = open_page()
    becomes(page, "#held_name", re.escape(EVIL))
    click(page, "#strip button >> nth=-1", "#grasp_title", re.escape(EVIL))
    page.click("#grasp_close")
    for tab in ("teach", "sort"):
        page.click(f"#tab_{tab}")
    becomes(page, "#taught b", re.escape(EVIL))
    cell.faulted()
    evil = {"number": 999, "text": EVIL, "remedy": EVIL, "steps": [EVIL, "mend"]}
    cell.changes = {"commander": EVIL, "fault": cell.state["fault"] | evil}
    becomes(page, "#fault_title", re.escape(EVIL))
    assert page.evaluate("[window.evil, document.querySelectorAll('[src=x]').length]") == [None, 0]


@pytest.mark.long
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("wide", [True, False], ids=["wide", "narrow"])
def test_all_states_fit_and_have_no_finding_of_axe(open_page, cell, scheme, wide) -> None:
    axe = pytest.importorskip("axe_playwright_python.sync_playwright").Axe()
    page = open_page(wide=wide, color_scheme=scheme, command=True)

    def check(name: str) -> None:
        violations = axe.run(page).response["violations"]
        assert not violations, (name, [(one["id"], one["nodes"][0]["html"]) for one in violations])
        assert fits(page), name
        if wide:
            assert page.evaluate("document.documentElement.scrollHeight <= innerHeight"), name

    for name in STATES:
        show(page, cell, name)
        check(name)
        if name == "idle":
            page.click("#strip button >> nth=-1")
            check("grasp")
            page.click("#grasp_close")
            page.click("#tab_teach")
            check("teach")
            page.click("#taught button >> nth=1")
            check("forget")
            page.click("#sure_no")
    cell.sends.clear()
    becomes(page, "#state", "Not connected")
    check("away")


@pytest.mark.long
def test_the_cell_is_gauged_with_a_taught_object(open_page, cell) -> None:
    page = open_page(command=True)
    click(page, "#tab_teach", "#gauge_now", "pads 1\u00a0%, opening 0.0\u00a0mm")
    page.click("#gauge_now")
    page.select_option("#gauge_label", "nut")
    cell.plugin.pause()
    page.click("#gauge_start")
    until(lambda: cell.asked)
    assert cell.asked == [("gauge", {"label": "nut"})]
    before, after = {"gain": 1.01, "opening_mm": 0.0}, {"gain": 0.71, "opening_mm": -3.9}
    cell.plugin.report(gauged={"label": "nut", "before": before, "after": after})
    cell.plugin.levels["drift"] = {"level": "watch"} | after
    cell.plugin.go_on()
    becomes(page, "#gauge_end", "from 1\u00a0%, 0.0\u00a0mm to -29\u00a0%, -3.9\u00a0mm")
    at = [float(page.get_attribute(f"#gauge_picture .{one}", "cx")) for one in ("before", "now")]
    assert at == pytest.approx([152.6, 74.6])


def test_an_object_is_taught_and_forgotten(open_page, cell) -> None:
    page = open_page(command=True)
    page.click("#tab_teach")
    page.fill("#teach_name", "washer")
    cell.plugin.pause()
    page.click("#teach_start")
    until(lambda: cell.asked)
    assert cell.asked == [("teach", {"label": "washer"})]  # as many grasps as by default
    cell.plugin.report(**TEACHING)
    becomes(page, "#teach_progress", "washer: 6 of 10 grasps – 1 missed")
    assert page.locator("#teach_each li").count() == 6
    becomes(page, "#do_teach, #teach_start", "a job runs")

    nearest = {"label": "washer", "n_grasps": 10, "nearest": "nut", "mistaken_share": 0.12}
    cell.plugin.report(taught=nearest | {"zero_note": "4 of 10 grasps"})
    cell.plugin.go_on()
    becomes(page, "#teach_end", "Similar to nut: 12% would be confused")
    becomes(page, "#teach_end", "Some grasps have no self-zero")
    page.click("[aria-label='Remove the last grasp of washer']")
    click(page, "#sure_yes", "#taught li:last-child small", "9 grasps")
    page.click("[aria-label='Forget washer']")
    click(page, "#sure_yes", "#taught li:last-child b", "pin")
    assert cell.given("forget") == [True, False]


@pytest.mark.long
def test_a_sort_shows_places_and_the_part_on_its_way(open_page, cell) -> None:
    page = open_page(command=True)
    page.click("#do_sort")
    page.fill("#sort_parts", "40")
    page.click("#sort_start")
    until(lambda: cell.asked)
    assert cell.given("sort")[0]["parts"] == 40
    show(page, cell, "sorting")
    becomes(page, "#sort_progress", "13 of 40 parts")
    becomes(page, "#sort_way", "nut is at tray A")
    assert page.locator("#sort_places b").all_text_contents() == ["7", "4", "1", "1"]
    becomes(page, "#sort_places .reject span", "rejects")


@pytest.mark.long
def test_what_is_not_allowed_is_grey_with_its_reason(open_page, cell) -> None:
    page = open_page(command=True)
    for name, selector, reason in (
        ("working", "#do_grip", "a job runs"),
        ("named", "#do_identify", "a part is held"),
        ("named", "#do_verify", "still the same part"),
    ):
        show(page, cell, name)
        becomes(page, selector, reason)
    cell.service.begin_stop("gate", "HTTP 10.0.0.7 gate")
    allowed = cell.state["allowed"]
    cell.changes = {"allowed": {task: allowed[task] for task in ("verify", "grip")}}
    becomes(page, "#do_verify", "on hold by HTTP 10.0.0.7 gate")
    becomes(page, "#doing", "On hold by HTTP 10.0.0.7 gate")
    becomes(page, "#do_sort", "not in this mode")
    for selector in ("#do_verify", "#do_sort"):
        page.click(selector, force=True)
    assert not cell.asked


@pytest.mark.long
def test_a_fault_reads_as_text_and_only_a_held_part_is_verified(open_page, cell) -> None:
    page = open_page(command=True)
    becomes(page, "#state", "Ready")
    becomes(page, "#do_verify", "only with a part in the grip")
    cell.changes = {"status": cell.state["status"] | {"state": "HELD", "holding": True}}
    becomes(page, "#do_verify", "on hold: release first")
    cell.changes = {}
    places = [page.locator(one).bounding_box() for one in ("#do_verify", "#do_sort")]
    show(page, cell, "named")
    becomes(page, "#do_verify", "still the same part")
    assert places == [page.locator(one).bounding_box() for one in ("#do_verify", "#do_sort")]
    cell.faulted()
    named = {"number": 999, "text": "use `a`", "cause": "`b`", "grip": "`c`", "detail": "`d`"}
    cell.changes = {"fault": cell.state["fault"] | named}
    becomes(page, "#fault_title", "use a")
    steps = page.locator("#fault_steps p").all_text_contents()
    assert len([step for step in steps if "upport" in step]) == 1
    assert "`" not in page.inner_text("body") + page.text_content("#fault_detail")


@pytest.mark.long
def test_health_is_one_line_until_something_is_not_well(page, cell) -> None:
    cell.plugin.levels["drift"] |= {"opening_mm": -0.001}
    becomes(page, "#health", r"All is well.* 0\.00 mm")
    assert page.locator("#health").bounding_box()["height"] < 45
    cell.plugin.levels["servos"] |= {"level": "watch", "temperature_c": [64.0, 41.0]}
    becomes(page, "#health span >> nth=0", "Attention – Servos: 64 °C")
    cell.plugin.levels["servos"]["level"] = "ok"
    cell.faulted()
    becomes(page, "#health", "^Servos")  # a fault is not well, whatever else is
    cell.changes = {"health": None}
    becomes(page, "#health", "sends no health values")


def test_what_is_not_measured_is_a_dash_and_an_old_frame_is_not_shown(open_page, cell) -> None:
    cell.working()
    page = open_page()
    becomes(page, "#state", "Working")
    page.wait_for_selector("#pads", state="visible")
    cell.plugin.show(live=LiveValues())
    becomes(page, "#measured_force", "–")
    page.wait_for_selector("#pads_none", state="visible")
    becomes(page, "#pads_none", "No frames of the pads")
    # With empty fingers the pads of the last answer stay.
    cell.idle()
    cell.plugin.show(live=LiveValues())
    page.wait_for_selector("#pads", state="visible")


@pytest.mark.long
def test_a_wrong_token_is_asked_for_again(open_page, cell) -> None:
    page = open_page(cell.url.partition("token=")[0] + "token=wrong")
    becomes(page, "#login_wrong", "refused")
    page.fill("#login_token", cell.url.partition("token=")[2])
    page.keyboard.press("Enter")
    becomes(page, "#state", "Ready")
    assert not page.is_visible("#login")


# -- The page on the real interface: on a stub of the cell, and once on the simulated cell ---------


class Line:
    """The line between a page and the cell, by the browser's own hooks."""

    def __init__(self) -> None:
        self.is_cut = False
        """Whether all connections end, and no new one begins."""
        self.is_mute = False
        """Whether answers and messages are lost on the way."""
        self.late_s = 0.0
        """By how much a state is older when it comes."""
        self.n_jobs = 0
        """Requests that start a job."""
        self._live: Any = None

    def join(self, page: Any) -> None:
        page.route("**/api/**", self._request)
        page.route_web_socket("**/api/live*", self._link)

    def cut(self) -> None:
        self.is_cut = True
        self._live.close()

    def _request(self, route: Any) -> None:
        if self.is_cut:
            route.abort()
            return
        self.n_jobs += route.request.url.endswith("/api/jobs")
        answer = route.fetch()
        route.abort() if self.is_mute else route.fulfill(response=answer)

    def _link(self, link: Any) -> None:
        if self.is_cut:
            link.close()
            return
        self._live = link
        link.connect_to_server().on_message(lambda message: self._message(link, message))

    def _message(self, link: Any, message: str | bytes) -> None:
        if isinstance(message, str) and self.late_s:
            state = json.loads(message)
            message = json.dumps(state | {"time_s": state["time_s"] - self.late_s})
        if not self.is_mute:
            link.send(message)


@pytest.fixture
def line() -> Line:
    return Line()


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
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


@pytest.mark.long
def test_a_cut_line_is_red_at_once_and_returns_by_itself(served, line, open_page) -> None:
    page = open_page(address(served), line=line, command=True)
    becomes(page, "#state", "Ready")
    line.cut()
    becomes(page, "#state", "Not connected")
    assert page.get_attribute("#band", "data-level") == "bad"
    assert page.text_content("#measured_force") == "–"
    becomes(page, "#do_identify", "not connected")
    page.evaluate("window.same = true")
    served.plugin.pause()
    served.service.start(served.service.lease.number, {"task": "grip", "force_n": 3.0})
    line.is_cut = False
    becomes(page, "#state", "Working")
    becomes(page, "#commander", "This page")
    assert page.evaluate("window.same")
    assert len(served.plugin.asked) == 1


@pytest.mark.long
def test_a_command_whose_answer_is_lost_is_done_once(served, line, open_page) -> None:
    page = open_page(address(served), line=line, command=True)
    line.is_mute = True
    page.click("#do_grip")
    becomes(page, "#state", "Not connected")
    assert line.n_jobs > 1
    line.is_mute = False
    becomes(page, "#state", "Part held")
    becomes(page, "#do_verify", "still the same part")
    assert (len(served.plugin.asked), page.text_content("#said")) == (1, "")


@pytest.mark.long
def test_a_slow_line_is_not_shown_as_live(served, line, open_page) -> None:
    page = open_page(address(served), line=line)
    becomes(page, "#state", "Ready")
    line.late_s = 1.5
    becomes(page, "#state", "Not connected")
    # It stays so while messages come, each too late.
    for _ in range(20):
        page.wait_for_timeout(100)
        assert page.text_content("#state") == "Not connected"
    line.late_s = 0.0
    becomes(page, "#state", "Ready")


@pytest.mark.long
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
    second = open_page(address(served), wide=False)
    click(second, "#simulated", "#sim_part option:checked", "another shape")
    for control, value in (("#sim_pose [name=x_m]", "1.5"), ("#sim_lengths [name=height]", "6")):
        assert second.locator(control).input_value() == value
    violations = axe.run(page).response["violations"]
    assert not violations, [(one["id"], one["nodes"][0]["html"]) for one in violations]
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


@pytest.mark.long
def test_a_second_person_watches_by_the_link(served, open_page) -> None:
    page = open_page(address(served), wide=False)
    click(page, "#share_open", "#share_note", "set serve.listen to 0.0.0.0")
    link = address(served).replace(served.interfaces["token"], served.interfaces["view_token"])
    becomes(page, f"#share_address[href='{link}']", link)
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
