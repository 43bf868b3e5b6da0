"""The service: one lease commands, anyone holds, nothing is done twice; and what it keeps."""

import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import date, datetime
from itertools import chain, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import DEFAULT, Mock

import pytest

from cell.control.part import Part
from cell.control.plan import Pose
from cell.control.states import Command
from cell.errors import CellError, CellStateError, HeldByClient, RequestRefused
from cell.recording.reader import read_recording
from cell.runtime import worker
from cell.service import history
from cell.service.history import MOST_ANSWERS, History, Shift, began_s, history_file, read_day
from cell.service.service import RELEASE_KEY
from gripper.errors import GraspStopped
from gripper.values.state import GripperPhase
from tactile.errors import FrameTimeout
from tests.cell.cells import once, small_config
from tests.cell.interfaces.hosts import Client
from tests.cell.served import LEASE_S, until

IDENTIFY = {"task": "identify", "max_grasps": 1, "present": "ball"}
KEEP = IDENTIFY | {"keep": "always"}


@pytest.fixture
def served(serve: Any) -> Any:
    return serve()


def test_a_request_that_starts_no_job_takes_no_part_in_turn(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    goal = {"task": "identify", "max_grasps": 1}
    for number in (1, 1, 2):  # the second one repeats the first one, whose answer was lost
        with pytest.raises(CellError):
            service.start(lease + 1, goal)
        assert service.start(lease, goal, number=number) == number
    assert [asked.present for asked in served.plugin.asked] == ["ball", "box"]


# -- the lease ---------------------------------------------------------------------------------


def test_a_lease_lasts_as_long_as_its_client_is_heard(served) -> None:
    lease = served.service.lease.acquire("first")
    for _ in range(3):
        served.clock.now_s += LEASE_S
        served.service.lease.alive(lease)
    served.clock.now_s += LEASE_S
    served.service.start(lease, IDENTIFY)
    served.clock.now_s += LEASE_S
    assert served.service.lease.has(lease)  # a command keeps it, too; looking does not
    served.clock.now_s += 0.1
    assert not served.service.lease.has(lease)
    assert served.service.lease.acquire("second")


@pytest.mark.parametrize("way", ["the button again", "clear", "clear of a fault"])
def test_a_hold_outlives_its_client_until_a_person_acts(served, way: str) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    if way == "clear of a fault":
        served.plugin.fail(FrameTimeout("no frame"))
    service.begin_stop(1, "panel", connected=True)
    service.begin_stop(3, "other", connected=True)
    service.leave_stop(1)
    service.leave_stop(2)
    assert service.held_by == ("panel (gone)", "other")
    service.begin_stop(2, "panel 2", connected=True)
    service.end_stop(2)  # another button is not this one
    assert service.held_by == ("panel (gone)", "other")
    if way == "the button again":
        service.begin_stop(4, "panel", connected=True)
        assert service.held_by == ("other", "panel")
        service.end_stop(4)
    else:
        served.ended(service.command(lease, Command.CLEAR))
        assert served.ended().outcome == "SUCCEEDED"
    assert service.held_by == ("other",)
    if way != "clear of a fault":
        with pytest.raises(CellStateError, match="'clear' is not allowed"):
            service.command(lease, Command.CLEAR)  # it stands: no clear lets a pressed button go
    with pytest.raises(HeldByClient, match="reset: other keeps the cell on hold"):
        service.command(lease, Command.RESET)
    with pytest.raises(HeldByClient, match="a restarted servo drops its part"):
        service.command(lease, Command.CLEAR, reboot=True)
    service.end_stop(3)
    if way != "clear of a fault":
        service.start(lease, IDENTIFY)
        assert served.ended().outcome == "SUCCEEDED"


def test_a_client_without_a_connection_repeats_its_hold(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    service.stop_as("HTTP 192.0.2.1 panel", None)  # once: nothing stays
    assert service.held_by == ()
    for _ in range(3):
        service.stop_as("HTTP 192.0.2.1 pa\x1b\0el", True)
        served.clock.now_s += LEASE_S
        service.lease.alive(lease)
        with pytest.raises(CellStateError, match="'clear' is not allowed"):
            service.command(lease, Command.CLEAR)
    served.clock.now_s += 1.0
    assert service.held_by == ("HTTP 192.0.2.1 pa??el (gone)",)
    with pytest.raises(HeldByClient):
        service.start(lease, IDENTIFY)
    service.stop_as("HTTP 192.0.2.1", False)
    assert service.held_by == ("HTTP 192.0.2.1 pa??el (gone)",)
    service.stop_as("HTTP 192.0.2.1 pa\x1b\0el", False)
    assert service.held_by == ()


def test_many_holds_do_not_grow_and_still_stop_the_job(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    for number in range(100):
        service.begin_stop(number, f"{number}")
    for number in range(100):
        service.end_stop(number)
    for number in range(99):
        service.begin_stop(number, f"{number}")
    assert service.plugin.job().number == 0
    service.begin_stop("last", "last")
    service.begin_stop("last", "last")
    with pytest.raises(RequestRefused, match="100 clients"):
        service.begin_stop("one more", "one more")
    assert len(service.held_by) == 100
    assert service.lease.has(lease)


def test_a_person_at_the_cell_takes_the_lease_and_holds_the_job(served) -> None:
    first = served.service.lease.acquire("first")
    served.plugin.pause()
    served.service.start(first, IDENTIFY)
    second = served.service.lease.acquire("operator", take=True)
    assert "because 'operator' took command" in served.ended().error
    assert (served.service.lease.has(first), served.service.lease.has(second)) == (False, True)
    assert served.state == "HELD"


# -- commands ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_jobs_of_a_simulated_cell_are_recorded_and_the_last_answer_is_kept(
    serve: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker, "MOST_JOBS", 2)
    served = serve(cell={"folder": tmp_path})
    service, lease = served.service, served.service.lease.acquire("first")
    service.start(lease, KEEP)
    assert served.ended().outcome == "SUCCEEDED"
    for number in range(3):
        if number == 2:
            served.plugin.cell.simulated.inject("unit.off")
        service.start(lease, {"task": "verify"})
        job = served.ended()
    assert (job.outcome, job.fault_number) == ("ABORTED", service.plugin.status().fault_number)
    # It outlives other jobs.
    assert served.plugin.job(1).part == served.plugin.status().last_answer
    assert served.plugin.job(1).part.label == "ball"
    with pytest.raises(RequestRefused, match="job 2 is not kept"):
        served.plugin.job(2)
    service.close()
    recording = read_recording(tmp_path / "recording.mcap")
    assert recording.complete
    assert [e["text"] for e in recording.events if e["kind"] in ("lease", "command", "job")] == [
        "'first' is in command",
        "job 1: identify, max_grasps 1, present ball, keep always, by 'first'",
        "identify succeeded",
        *(text for n in (2, 3) for text in (f"job {n}: verify, by 'first'", "verify succeeded")),
        "job 4: verify, by 'first'",
        f"verify failed: {job.error}",
    ]


def test_a_repeated_request_is_not_done_twice(served) -> None:
    lease = served.service.lease.acquire("first")
    for _ in range(3):
        assert served.service.start(lease, KEEP, number=1) == 1
    served.ended()
    assert served.service.start(lease, KEEP, number=1) == 1
    assert served.plugin.job().number == 1
    with pytest.raises(RequestRefused, match="job 1 belongs to another request; use 2"):
        served.service.command(lease, Command.RELEASE, key=RELEASE_KEY, number=1)
    with pytest.raises(RequestRefused, match="job 3 is not the next job; the next is 2"):
        served.service.start(lease, KEEP, number=3)
    served.service.lease.give_up(lease)
    lease = served.service.lease.acquire("second")
    with pytest.raises(RequestRefused, match="another request"):
        served.service.start(lease, KEEP, number=1)
    assert served.grip_n > 1.0


def test_labels_have_ids_that_the_config_fixes(make_plugin: Any, taught: Any) -> None:
    plugin = make_plugin(small_config(serve__objects=["cube", "box"]), model=taught.result.model)
    assert plugin.labels_by_id == plugin.info()["labels"] == ("cube", "box", "ball")
    assert {one["label"]: one["label_id"] for one in plugin.taught()} == {"ball": 3, "box": 2}


def test_each_command_is_remarked_with_its_client(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    service.start(lease, KEEP)
    with pytest.raises(RequestRefused, match=r"the key is 0x.*, not 0x4f50"):
        service.command(lease, Command.RELEASE, key=1)
    with pytest.raises(CellStateError):
        service.command(lease, Command.RESET)
    service.command(lease, Command.RELEASE, key=RELEASE_KEY)
    served.plugin.pause()
    service.start(lease, {"task": "grip", "force_n": 3.0})
    served.pass_lease()
    silent = "because 'first' was silent for 61.00 s"
    assert [(kind, text[:60]) for kind, text in served.plugin.remarks] == [
        ("lease", "'first' is in command"),
        ("command", "job 1: identify, max_grasps 1, present ball, keep always, by 'first'"[:60]),
        ("command", "job 2: release, by 'first'"),
        ("command", "job 2 refused: release: the key is 0x1, not 0x4f50; with it "),
        ("command", "job 2: reset, by 'first'"),
        ("command", "job 2 refused: the cell is COMPLETE; allowed: verify, release"[:60]),
        ("command", "job 2: release, by 'first'"),
        ("command", "job 3: grip, force_n 3.0, present ball, by 'first'"),
        ("lease", f"nobody is in command, {silent}"[:60]),
        ("hold", silent),
    ]


# -- the pose handshake ------------------------------------------------------------------------


@pytest.mark.slow
def test_a_hold_while_a_pose_is_waited_for_leaves_nothing_behind(serve: Any) -> None:
    served = serve(cell={}, positioner__kind="callback")
    service, lease = served.service, served.service.lease.acquire("robot")
    for _ in range(2):
        service.start(lease, IDENTIFY)
        seq = until(lambda: service.snapshot().pose_seq)
        service.stop()
        assert served.ended().outcome == "CANCELED"
        assert service.snapshot().pose_seq == 0
        with pytest.raises(RequestRefused):
            service.pose_reached(lease, seq)
        if served.state == "HELD":
            service.command(lease, Command.RELEASE, key=RELEASE_KEY)
            served.ended()
    service.start(lease, IDENTIFY)
    service.pose_reached(lease, until(lambda: service.snapshot().pose_seq))
    assert served.ended().outcome == "SUCCEEDED"
    with pytest.raises(GraspStopped):  # a job that a fault has ended waits for no pose
        service._poses.move(Pose())


# -- the end -----------------------------------------------------------------------------------


def test_the_watch_notices_a_silent_client_by_itself_and_outlives_what_goes_wrong(
    serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    served = serve(note=notes.append, serve__lease_timeout_s=0.2)
    fails_once = chain([OSError("the pipe is broken")], repeat(DEFAULT))
    cancel = Mock(wraps=served.plugin.cancel, side_effect=fails_once)
    monkeypatch.setattr(served.plugin, "cancel", cancel)
    for client in ("first", "second"):
        lease = served.service.lease.acquire(client)
        if client == "first":
            served.plugin.pause()
            served.service.start(lease, IDENTIFY)
        served.clock.now_s += 1.0
        until(lambda: not served.service.lease.number)
    until(lambda: notes)
    assert notes[0] == "watch over the lease: the pipe is broken"
    served.service.stop()
    assert served.ended().outcome == "CANCELED"
    assert served.state == "HELD"


@pytest.mark.slow
def test_no_part_is_exchanged_while_a_job_closes_on_it(serve: Any) -> None:
    served = serve(cell={}, host_timeout_s=0.05)  # of a Python host: a service has leases instead
    service, hand = served.service, served.plugin.cell.controller.hand
    lease = service.lease.acquire("trainer")

    def exchange() -> None:
        with pytest.raises(CellStateError, match="job 1 is not over; wait for its result or"):
            service.choose_part(lease, "box", Pose())

    asked_s = once(
        served.plugin.cell.simulated.clock, lambda: hand.phase is GripperPhase.APPROACHING, exchange
    )
    service.start(lease, IDENTIFY)
    assert served.ended().part.label == "ball"
    assert asked_s
    service.choose_part(lease, "box", Pose())


# -- What a service keeps: the ledger of a shift, the history --------------------------------------


class Wall:
    """A wall clock that the test sets."""

    def __init__(self) -> None:
        self.now_s, self.n_parts = datetime(2027, 3, 1, 8, 0).timestamp(), 0

    def __call__(self) -> float:
        return self.now_s

    def part(self, label: str = "ball", seconds: float = 4.0, **fields: Any) -> Part:
        """A part of this moment, with the next number."""
        self.n_parts += 1
        return part(label, seconds, **{"number": self.n_parts, "time_s": self.now_s} | fields)


def part(label: str = "ball", seconds: float = 4.0, **fields: Any) -> Part:
    others = {"ball": 0.1, "box": 0.05, "UNKNOWN": 0.02, label: 0.83}
    known = {"label": label, "probabilities": others, "n_grasps": 2, "seconds": seconds}
    return Part(task="sort", **known | fields)


def test_parts_rejects_misses_and_faults_are_counted_apart() -> None:
    clock = Wall()
    shift = Shift(n_faults=lambda: 2, wall_clock=clock)
    fresh = {"parts": 0, "cycle_s": None, "counts": {}, "answers": []}
    assert shift.values().items() >= fresh.items()
    for label, fields in (
        ("ball", {"seconds": 3.0, "place": "left"}),
        ("box", {"seconds": 5.0, "place": "right"}),
        ("UNKNOWN", {"seconds": 9.0, "place": "reject", "rejected": True}),
    ):
        clock.now_s += 60.0
        shift.add(clock.part(label, **fields))
    shift.add(Part(task="sort", seconds=7.0))
    values = shift.values()
    assert (values["parts"], values["rejected"], values["missed"], values["faults"]) == (3, 1, 1, 2)
    assert values["counts"] == {"ball": 1, "box": 1, "UNKNOWN": 1}
    assert (values["cycle_s"], values["parts_last_hour"]) == (5.0, 3)
    first = values["answers"][0]
    assert (first.number, first.label, first.place) == (1, "ball", "left")
    assert first.runner_up == {"label": "box", "probability": 0.05}
    assert first.time_s == values["since_s"] + 60.0


def test_the_ledger_stays_small() -> None:
    clock = Wall()
    shift = Shift(wall_clock=clock)
    for number in range(5000):
        clock.now_s += 1.0
        shift.add(clock.part(), {"t_s": [float(number)]})
    values = shift.values()
    assert (values["parts"], values["parts_last_hour"]) == (5000, 3600)
    assert [one.number for one in values["answers"]] == list(range(5001 - MOST_ANSWERS, 5001))
    assert shift.curves(5000) == {"t_s": [4999.0]}
    assert shift.part(5001 - MOST_ANSWERS).number == 5001 - MOST_ANSWERS
    with pytest.raises(RequestRefused, match="part 4980 is not kept; the newest is 5000"):
        shift.part(5000 - MOST_ANSWERS)
    stored = (shift._times_s, shift._cycles_s, shift.parts, shift._curves)
    assert tuple(map(len, stored)) == (3600, 1000, 20, 20)
    clock.now_s += 3599.0
    assert shift.values()["parts_last_hour"] == 1
    clock.now_s += 1.0
    assert shift.values()["parts_last_hour"] == 0


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv("TZ", "Europe/Berlin")
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()


@pytest.mark.parametrize(
    ("now", "begins_h", "began"),
    [
        ((1, 8, 0), (0.0,), (1, 0, 0)),
        ((1, 5, 59), (6.0, 14.0, 22.0), (0, 22, 0)),
        ((1, 6, 0), (22.0, 6.0, 14.0), (1, 6, 0)),
        ((1, 21, 59), (6.0, 14.0, 22.0), (1, 14, 0)),
        ((1, 5, 0), (5.5,), (0, 5, 30)),
        ((27, 3, 5), (2.5, 14.0), (26, 14, 0)),  # 02:30 is left out on this day
    ],
)
@pytest.mark.usefixtures("berlin")
def test_a_shift_begins_at_hours_of_the_local_day(now: Any, begins_h: Any, began: Any) -> None:
    at_s = [datetime(2027, 3, 1 + day, *clock).timestamp() for day, *clock in (now, began)]
    assert began_s(at_s[0], begins_h) == at_s[1]


def test_a_new_shift_begins_with_no_figures_and_parts_keep_their_numbers() -> None:
    clock, faults = Wall(), [0]
    shift = Shift((6.0, 14.0), lambda: faults[0], clock)
    for n_parts in (3, 0, 2):
        for _ in range(n_parts):
            shift.add(clock.part())
        faults[0] += 1
        clock.now_s = shift.began_s - 5.0  # set back
        values = shift.values()
        assert values["parts"] == values["counts"].get("ball", 0) == n_parts
        assert values["faults"] == 1
        clock.now_s = values["since_s"] + 16.1 * 3600.0
        assert shift.values()["parts"] == shift.values()["faults"] == 0
    assert [one.number for one in shift.parts] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("leap_s", [-4000.0, -1e8, 1e8])
def test_a_clock_that_leaps_lets_no_times_grow(leap_s: float) -> None:
    clock = Wall()
    shift = Shift(wall_clock=clock)
    for _ in range(10):
        shift.add(clock.part())
    clock.now_s += leap_s
    shift.add(clock.part())
    assert shift.values()["parts_last_hour"] == len(shift._times_s) == 1
    assert shift.values()["parts"] == (11 if abs(leap_s) < 1e4 else 1)


# -- The history of a cell: a week of shifts in a table per day, and what it survives --------------


MONDAY_S = datetime(2027, 3, 1, 6, 0).timestamp()
DAY_S = 86_400.0


class Stored:
    """A history whose clock and faults the test sets; each look is a call."""

    def __init__(self, path: Path) -> None:
        self.path, self.now_s, self.notes = path, MONDAY_S, list[str]()
        self.state = SimpleNamespace(n_faults=0, fault=None, fault_number=0)
        self.begin()

    def begin(self) -> None:
        """Start the program, which may have been killed."""
        self.state.n_faults, self.state.fault = 0, None
        faults, wall = lambda: self.state.n_faults, lambda: self.now_s
        self.shift = Shift((6.0, 14.0, 22.0), faults, wall)
        self.history = History(
            self.path, lambda: self.state, note=self.notes.append, shift=self.shift, wall_s=wall
        )

    def fault(self, number: int, text: str) -> None:
        n_faults = self.state.n_faults + 1
        self.state = SimpleNamespace(n_faults=n_faults, fault=text, fault_number=number)

    def add(self, part: Part) -> None:
        self.history.add(part.model_copy(update={"time_s": self.now_s}))

    def look(self) -> dict[str, Any]:
        self.now_s += 61.0
        self.history.update()
        return self.history.values()


@pytest.fixture
def stored(tmp_path: Path) -> Iterator[Stored]:
    stored = Stored(history_file(tmp_path / "out", "press 4 / left"))
    yield stored
    stored.history.close()
    stored.history._close_link()


def test_a_week_of_shifts_survives_kills_and_is_summed_by_day_and_week(stored: Stored) -> None:
    for day in range(7):
        for shift in range(3):
            stored.now_s = MONDAY_S + day * DAY_S + shift * 3600.0
            stored.begin()
            for number in range(40):
                named = "box" if number % 10 == 0 else "ball"
                stored.add(part(named, presented="ball", seconds=4.0 + shift))
            stored.add(part("UNKNOWN", presented="pin", rejected=True))
            stored.add(part(""))
            stored.look()
            stored.fault(301 + shift, "a servo is hot")
            stored.look()
    values = stored.history.values()
    day = {"parts": 123, "rejected": 3, "missed": 3, "faults": 3, "starts": 3}
    assert {name: values["today"][name] for name in day} == day
    assert {name: values["yesterday"][name] for name in day} == day
    assert {name: values["week"][name] for name in day} == {k: 7 * v for k, v in day.items()}
    assert values["today"]["cycle_s"] == pytest.approx((3 * 4.0 + 40 * (4.0 + 5.0 + 6.0)) / 123)
    assert values["today"]["confused"] == [
        {"held": "ball", "named": "box", "n": 12, "confirmed": True}
    ]
    rows = read_day(stored.path, date(2027, 3, 7))
    assert [row["fault_number"] for row in rows if row["kind"] == "fault"] == [301, 302, 303]
    assert rows[-1]["text"] == "a servo is hot"
    assert read_day(stored.path, date(2027, 3, 8)) == []
    # A new week begins on Monday.
    stored.now_s = MONDAY_S + 7 * DAY_S
    values = stored.look()
    assert (values["today"]["parts"], values["yesterday"]["parts"]) == (0, 123)
    assert values["week"]["parts"] == 0
    assert stored.notes == []


def test_a_shift_goes_on_after_a_restart_and_ends_with_its_hours(stored: Stored) -> None:
    def figures() -> tuple[Any, ...]:
        values = stored.shift.values()
        names = ("parts", "rejected", "missed", "faults", "cycle_s", "parts_last_hour", "counts")
        return (values["since_s"] - MONDAY_S, *(values[name] for name in names))

    def work(seconds: float) -> None:
        now = {"time_s": stored.now_s}
        pin, box = part("pin", seconds=seconds, **now), part("box", rejected=True, **now)
        for report in (pin, box, part("", **now)):
            stored.history.add(report)
            stored.shift.add(report)
        stored.fault(301, "a servo is hot")
        stored.look()

    work(3.0)
    stored.now_s += 3600.0
    stored.begin()
    assert figures()[1] == 0
    stored.look()
    assert figures() == (0.0, 2, 1, 1, 1, 3.5, 0, {"pin": 1, "box": 1})
    work(5.0)
    assert figures() == (0.0, 4, 2, 2, 2, 4.0, 2, {"pin": 2, "box": 2})
    stored.begin()
    stored.shift.add(part("pin", time_s=stored.now_s))  # a part before the disk has answered
    stored.look()
    assert figures()[1:5] == (5, 2, 2, 2)
    stored.look()
    assert figures()[1] == 5
    # A night shift has two days; nothing of the late shift counts.
    stored.now_s = MONDAY_S + 16.5 * 3600.0
    stored.begin()
    work(3.0)
    stored.now_s = MONDAY_S + 20.0 * 3600.0
    stored.begin()
    stored.look()
    assert figures()[:3] == (16.5 * 3600.0, 2, 1)
    stored.now_s = MONDAY_S + 24.0 * 3600.0
    stored.look()
    stored.fault(301, "a servo is hot")  # before anybody asks for the figures
    stored.now_s += 600.0
    assert figures()[1:5] == (0, 0, 0, 1)


def test_the_sums_have_each_row_before_the_disk_has_it(stored: Stored) -> None:
    stored.add(part())
    stored.look()
    for report in (part(), part("")):
        stored.add(report)
    stored.fault(301, "a servo is hot")
    expected = {"parts": 2, "missed": 1, "faults": 1}
    for values in (stored.history.values(), stored.look()):
        assert values["today"].items() >= expected.items()


def test_a_row_that_comes_while_a_full_queue_is_written_is_kept(stored, monkeypatch) -> None:
    monkeypatch.setattr(history, "_WAITING_MAX", 1)
    stored.begin()
    opened = stored.history._opened
    monkeypatch.setattr(stored.history, "_opened", lambda: (stored.add(part()), opened())[1])
    stored.look()
    assert stored.history._waiting


def test_a_fault_of_the_start_is_in_the_history(stored: Stored) -> None:
    stored.fault(506, "a part is in the grip")
    stored.history = History(stored.path, lambda: stored.state, wall_s=lambda: stored.now_s)
    stored.look()
    assert stored.history.values()["today"]["faults"] == 1


def test_without_a_word_what_was_held_the_second_label_counts_where_it_is_near(stored) -> None:
    for _ in range(3):
        stored.add(part("pin"))  # the second has 0.1
    assert stored.look()["today"]["confused"] == [
        {"held": "ball", "named": "pin", "n": 3, "confirmed": False}
    ]


def test_a_clock_that_leaps_loses_no_day(stored: Stored) -> None:
    stored.add(part())
    stored.look()
    for leap_s in (3650 * DAY_S, -20 * 365 * DAY_S):
        stored.now_s += leap_s
        stored.add(part())
        assert stored.look()["today"]["parts"] == 1
    assert len(read_day(stored.path, date(2027, 3, 1))) == 2


def test_the_first_days_go_when_there_are_many(stored, monkeypatch) -> None:
    monkeypatch.setattr(history, "MOST_DAYS", 3)
    for day in range(5):
        stored.now_s = MONDAY_S + day * DAY_S
        stored.add(part())
        stored.look()
    left = [bool(read_day(stored.path, date(2027, 3, 1 + day))) for day in range(5)]
    assert left == [False, False, True, True, True]


def test_a_disk_that_takes_nothing_is_noted_once_and_gets_the_rows_later(stored, tmp_path) -> None:
    (tmp_path / "out").write_text("a file in the place of the folder")
    for _ in range(3):
        stored.add(part())
        assert stored.look() == {}
    assert len(stored.notes) == 1
    assert "the history is not kept" in stored.notes[0]
    (tmp_path / "out").unlink()
    assert stored.look()["today"]["parts"] == 3
    with closing(sqlite3.connect(stored.path)) as other:  # a program that holds it for a while
        other.execute("BEGIN IMMEDIATE")
        stored.add(part())
        stored.look()
        assert "locked" in stored.notes[-1]
        stored.now_s += DAY_S
        stored.add(part())
        assert stored.look()["today"]["parts"] == 1
    assert stored.look()["yesterday"]["parts"] == 4


def test_a_damaged_file_and_one_of_another_version_are_left_as_they_are(stored: Stored) -> None:
    stored.look()
    stored.history._close_link()
    with closing(sqlite3.connect(stored.path)) as link:
        link.execute("PRAGMA user_version = 1")
    other = stored.path.read_bytes()
    for content, cause in (
        (b"no data base at all, but long enough to be looked at" * 100, "not a database"),
        (other, "has a table of version 1, but tactile-cell"),
    ):
        stored.path.write_bytes(content)
        stored.add(part())
        stored.look()
        assert cause in stored.notes[-1]
        assert "move a damaged file away" in stored.notes[-1]
        assert stored.path.read_bytes() == content
    with pytest.raises(CellError, match="cannot read the history"):
        read_day(stored.path.with_name("none.sqlite3"), date(2027, 3, 1))


@pytest.mark.slow
def test_the_service_keeps_it_and_http_shows_it(tmp_path: Path, serve: Any) -> None:
    folder = tmp_path / "out" / "serve-20270301-060000"
    folder.mkdir(parents=True)
    served = serve("http", cell={"folder": folder})
    service, host = served.service, Client(served.interfaces)
    service.start(service.lease.acquire("test"), {"task": "identify", "present": "box"})
    assert served.ended().part.label == "box"
    until(lambda: service.history.values().get("today", {}).get("parts"))
    assert host.get("/api/history") == service.history.values()
    rows = host.get(f"/api/history?day={date.today()}")["rows"]
    assert [row["kind"] for row in rows] == ["start", "part"]
    service.close()
    path = history_file(tmp_path / "out", small_config().name)
    (row,) = (one for one in read_day(path, date.today()) if one["kind"] == "part")
    assert (row["label"], row["presented"]) == ("box", "box")
