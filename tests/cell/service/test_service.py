"""The service: one lease commands, anyone holds, nothing is done twice, nothing resumes."""

import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from cell.control.plan import Pose
from cell.control.states import Command
from cell.data.recording_reader import read_recording
from cell.errors import CellError, CellStateError, ConfigError, HeldByClient, RequestRefused
from cell.plugin import worker
from cell.service import service as service_module
from cell.service.service import RELEASE_KEY
from gripper.values.state import GripperPhase
from tactile.errors import FrameTimeout
from tests.cell.conftest import once, small_config
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


def test_a_button_holds_the_cell_until_each_client_has_let_go(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    served.plugin.pause()
    service.start(lease, IDENTIFY)
    service.begin_stop(1, "panel 1", connected=True)
    service.begin_stop(2, "panel 2", connected=True)
    assert "stopped by panel" in served.ended().error
    assert (served.state, served.grip_n > 1.0) == ("HELD", True)
    for left, name in ((1, "panel 1, panel 2"), (2, "panel 2")):
        assert ", ".join(service.snapshot().held_by) == name
        for command in (Command.RELEASE, Command.RESET):
            with pytest.raises(HeldByClient, match=f"{command}: {name} keeps the cell on hold"):
                service.command(lease, command, key=RELEASE_KEY)
        with pytest.raises(HeldByClient):
            service.start(lease, IDENTIFY)
        service.end_stop(left)
        service.end_stop(left)
    assert (service.held_by, service.job().number, served.grip_n > 1.0) == ((), 1, True)
    service.command(lease, Command.RELEASE, key=RELEASE_KEY)
    assert served.ended(2).outcome == "SUCCEEDED"


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
    with pytest.raises(HeldByClient):
        service.command(lease, Command.RESET)
    service.end_stop(3)
    if way != "clear of a fault":
        service.start(lease, IDENTIFY)
        assert served.ended().outcome == "SUCCEEDED"


def test_a_client_without_a_connection_repeats_its_hold(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    service.stop_as("HTTP 192.0.2.1 panel", None)  # once: nothing stays
    assert service.held_by == ()
    for _ in range(3):
        service.stop_as("HTTP 192.0.2.1 panel", True)
        served.clock.now_s += LEASE_S
        service.lease.alive(lease)
        with pytest.raises(CellStateError, match="'clear' is not allowed"):
            service.command(lease, Command.CLEAR)
    served.clock.now_s += 1.0
    assert service.held_by == ("HTTP 192.0.2.1 panel (gone)",)
    with pytest.raises(HeldByClient):
        service.start(lease, IDENTIFY)
    service.stop_as("HTTP 192.0.2.1", False)
    assert service.held_by == ("HTTP 192.0.2.1 panel (gone)",)
    service.stop_as("HTTP 192.0.2.1 panel", False)
    assert service.held_by == ()


def test_many_holds_do_not_grow_and_still_stop_the_job(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    for number in range(100):
        service.begin_stop(number, f"{number}")
    for number in range(100):
        service.end_stop(number)
    for number in range(99):
        service.begin_stop(number, f"{number}")
    assert service.job().number == 0
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
def test_jobs_of_a_simulated_cell_are_recorded_with_who_asked(serve: Any, tmp_path: Path) -> None:
    served = serve(cell={"folder": tmp_path})
    service, lease = served.service, served.service.lease.acquire("first")
    service.start(lease, KEEP)
    assert served.ended(1).kept
    service.command(lease, Command.RELEASE, key=RELEASE_KEY)
    assert served.ended(2).outcome == "SUCCEEDED"
    served.plugin._cell.simulated.inject("unit.off@contact+50ms")
    service.start(lease, {"task": "grip", "force_n": 3.0})
    job = served.ended(3)
    assert (job.outcome, job.fault_number) == ("ABORTED", service.status().fault_number)
    service.close()
    recording = read_recording(tmp_path / "recording.mcap")
    assert recording.complete
    events = [e["text"] for e in recording.events if e["kind"] in ("lease", "command", "job")]
    for earlier, later in pairwise(
        (
            "'first' is in command",
            "job 1: identify, max_grasps 1, present ball, keep always, by 'first'",
            "job 2: release, by 'first'",
            "release succeeded",
            "job 3: grip, force_n 3.0, present ball, by 'first'",
            f"grip failed: {job.error}",
        )
    ):
        assert events.index(earlier) < events.index(later)


def test_the_last_answer_outlives_the_jobs_that_are_kept(serve: Any, monkeypatch: Any) -> None:
    for module in (worker, service_module):
        monkeypatch.setattr(module, "KEPT_JOBS", 2)
    served = serve()
    lease = served.service.lease.acquire("first")
    served.service.start(lease, KEEP)
    served.ended()
    for _ in range(3):
        served.service.start(lease, {"task": "verify"})
        served.ended()
    assert served.service.job(1) == served.service.snapshot().last_answer
    assert served.service.job(1).label == "ball"
    with pytest.raises(RequestRefused, match="no job 2"):
        served.service.job(2)


def test_a_repeated_request_is_not_done_twice(served) -> None:
    lease = served.service.lease.acquire("first")
    for _ in range(3):
        assert served.service.start(lease, KEEP, number=1) == 1
    served.ended()
    assert served.service.start(lease, KEEP, number=1) == 1
    assert served.service.job().number == 1
    with pytest.raises(RequestRefused, match="job 1 is another request; the next is 2"):
        served.service.command(lease, Command.RELEASE, key=RELEASE_KEY, number=1)
    with pytest.raises(RequestRefused, match="job 3 is not the next job; the next is 2"):
        served.service.start(lease, KEEP, number=3)
    served.service.lease.give_up(lease)
    lease = served.service.lease.acquire("second")
    with pytest.raises(RequestRefused, match="another request"):
        served.service.start(lease, KEEP, number=1)
    assert served.grip_n > 1.0


def test_labels_have_ids_that_the_config_fixes(serve: Any) -> None:
    assert serve().service.labels == ("ball", "box")
    service = serve(serve__objects=["cube", "box"]).service
    assert service.labels == ("cube", "box", "ball")
    assert [service.label_id(label) for label in ("cube", "ball", "UNKNOWN")] == [1, 3, 0]
    assert service.info()["labels"] == ["cube", "box", "ball"]


def test_each_command_is_remarked_with_its_client(served) -> None:
    service, lease = served.service, served.service.lease.acquire("first")
    service.start(lease, KEEP)
    for key in (1, 0, RELEASE_KEY + 1, 0x504F):
        with pytest.raises(RequestRefused, match="is not the key"):
            service.command(lease, Command.RELEASE, key=key)
    with pytest.raises(RequestRefused, match="no job 2; the newest is 1"):
        service.job(2)
    del served.plugin.remarks[4:]
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
        ("command", "job 2 refused: release: 0x1 is not the key; with it the part"),
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


# -- the end -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_end_of_the_service_keeps_the_part_and_ends_all_threads(serve: Any) -> None:
    before = set(threading.enumerate())
    served = serve(cell={}, positioner__kind="callback", host_timeout_s=0.05)
    assert [one.name for one in threading.enumerate()].count("lease") == 1
    lease = served.service.lease.acquire("first")
    served.service.start(lease, {"task": "grip", "force_n": 3.0})
    until(lambda: served.service.snapshot().pose_seq)
    served.service.close()
    served.service.close()
    assert served.ended().outcome == "CANCELED"
    with pytest.raises(CellStateError, match="the cell is closed"):
        served.service.start(served.service.lease.acquire("late", take=True), IDENTIFY)
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"serve__hosts": ["http://cell.lan"]}, "not a host name"),
        ({"serve__hosts": ["cell.lan:80"]}, "not a host name"),
        ({"serve__hosts": [""]}, "not a host name"),
        ({"serve__listen": "0.0.0.0"}, "serve.allow is empty"),
        ({"serve__listen": "localhost"}, "does not appear to be"),
        ({"serve__allow": ["everyone"]}, "does not appear to be"),
        ({"serve__tls_key": "key.pem"}, "set both"),
        ({"serve__objects": ["ball", "ball"]}, "twice"),
        ({"serve__modbus_port": 65536}, "65535"),
    ],
)
def test_a_config_that_opens_interfaces_to_nobody_in_particular_is_refused(
    changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        small_config(**changes)


def test_the_watch_notices_a_silent_client_by_itself_and_outlives_what_goes_wrong(
    serve: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    notes: list[str] = []
    served = serve(note=notes.append, serve__lease_timeout_s=0.2)
    cancel, failed = served.plugin.cancel, threading.Event()

    def fail_once(*arguments: Any) -> None:
        if not failed.is_set():
            failed.set()
            raise OSError("the pipe is broken")
        cancel(*arguments)

    monkeypatch.setattr(served.plugin, "cancel", fail_once)
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
    served = serve(cell={})
    service, hand = served.service, served.plugin._cell.controller.hand
    lease = service.lease.acquire("trainer")
    refused: list[str] = []

    def exchange() -> None:
        with pytest.raises(CellStateError) as error:
            service.choose_part(lease, "box", Pose())
        refused.append(str(error.value))

    once(
        served.plugin._cell.simulated.clock,
        lambda: hand.phase is GripperPhase.APPROACHING,
        exchange,
    )
    service.start(lease, IDENTIFY)
    assert (served.ended().label, refused) == (
        "ball",
        ["job 1 is not over; wait for its result or cancel it"],
    )
    service.choose_part(lease, "box", Pose())
