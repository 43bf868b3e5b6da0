"""What every interface promises its hosts: lease, hold, refusals, kept part, answer, poses."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest

from cell.control.keeping import Keep
from cell.control.plan import Pose
from cell.control.states import Command
from cell.service.service import RELEASE_KEY
from gripper.errors import ServoFault
from tests.cell.interfaces.hosts import HOSTS, NOT_IN_COMMAND, Host, Request
from tests.cell.served import Served
from tests.waiting import LIMIT_S

IDENTIFY = Request(task="identify", max_grasps=2, force_n=6.0, keep=Keep.ALWAYS)
GRIP = Request(task="grip", force_n=3.0)
RELEASE = Request(task="release", key=RELEASE_KEY)
REFUSED, NOT_ALLOWED, CONFIG, HELD_ON_REQUEST, ON_HOLD = 513, 505, 501, 512, 515
IDLE, EXECUTE, ABORTED, HELD, COMPLETE = 4, 6, 9, 11, 17
SUCCEEDED, CANCELED, FAILED = 4, 5, 6


Connect = Callable[..., tuple[Served, Host]]


@pytest.fixture(params=HOSTS)
def connect(request: pytest.FixtureRequest, serve: Any) -> Iterator[Connect]:
    """Return the maker of a served cell and a host of each interface; with a cell another host."""
    with ExitStack() as undo:

        def make(served: Served | None = None) -> tuple[Served, Host]:
            name = request.param
            served = served or serve(name)
            return served, undo.enter_context(closing(HOSTS[name](served.interfaces)))

        yield make


def check_shown(host: Host, **expected: Any) -> None:
    """Check what an interface shows of these values."""
    shown = expected | host.shown()
    found = {
        name: bool(shown[name]) if isinstance(value, bool) else shown[name]
        for name, value in expected.items()
    }
    assert found == pytest.approx(expected)


def check_refusal(host: Host, number: int) -> None:
    shown, text = host.refusal()
    assert (shown, bool(text)) == (number, True)


def test_a_part_is_identified_verified_and_let_go_with_its_key_alone(connect: Connect) -> None:
    served, host = connect()
    check_shown(host, state=IDLE, grip=0, holding=False, needs_reset=False, on_hold=False, fault=0)
    check_shown(host, recording=False, job=0, outcome=0, pose_seq=0, answer_job=False, part=False)
    check_shown(host, force_n=0.0, opening_mm=40.0)
    assert host.acquire() == 0
    assert host.send(IDENTIFY, 1) == host.repeat() == host.repeat() == 1  # done once
    (goal,) = served.plugin.asked
    assert (goal.force_n, goal.max_grasps, goal.keep) == (6.0, 2, "always")
    named = {"label": "ball", "label_id": 1, "probability": 0.9, "size_mm": 9.5}
    answer = named | {"answer_job": 1, "kept": True, "part": 1, "part_label_id": 1}
    check_shown(host, state=COMPLETE, holding=True, job=1, outcome=SUCCEEDED, n_grasps=1, **answer)
    check_shown(host, force_n=3.25, setpoint_n=3.25, opening_mm=9.5, temperature_c=31.0)
    check_shown(host, force_age_s=0.005, frame_age_s=0.02)
    assert host.send(Request(task="verify"), 2) == 2
    for key in (0, 0x504F, 1):
        assert host.send(Request(task="release", key=key), 3) == -REFUSED
        check_refusal(host, REFUSED)
    assert served.grip_n > 1.0
    assert host.send(RELEASE, 3) == 3
    check_shown(host, state=IDLE, holding=False, job=3, force_n=0.0, **answer)
    assert served.grip_n == 0.0
    assert host.send(Request(task="teach", label="box", max_grasps=5), 4) == 4
    assert (served.plugin.asked[-1].label, served.plugin.asked[-1].grasps) == ("box", 5)
    served.plugin.pause()
    assert host.send(IDENTIFY, 5) == 5
    check_shown(host, job=5, answer_job=False)  # until the next identification begins
    served.plugin.go_on()
    assert host.send(IDENTIFY, 6) == -NOT_ALLOWED
    check_shown(host, state=COMPLETE, answer_job=5)
    assert host.send(Request(task="shutdown"), 6) == 6
    unmeasured = ("force_n", "force_age_s", "setpoint_n", "opening_mm", "frame_age_s")
    check_shown(host, state=2, temperature_c=None, **dict.fromkeys(unmeasured))


def test_what_is_refused_has_a_number_and_a_reason_and_starts_nothing(connect: Connect) -> None:
    served, host = connect()
    assert host.send(IDENTIFY, 1) == -NOT_IN_COMMAND
    assert host.acquire() == 0
    for request, number in (
        (Request(task="verify"), NOT_ALLOWED),
        (Request(task="grip", force_n=600.0), CONFIG),
        (Request(task="reset"), NOT_ALLOWED),
    ):
        assert host.send(request, 1) == -number
        check_refusal(host, number)
    check_shown(host, state=IDLE, job=0)
    assert served.plugin.asked == []


def test_a_second_host_is_refused_and_may_hold(connect: Connect) -> None:
    served, first = connect()
    _, second = connect(served)
    assert first.acquire() == 0
    assert second.acquire() == NOT_IN_COMMAND
    served.plugin.pause()
    assert first.send(IDENTIFY, 1) == 1
    check_shown(first, state=EXECUTE, outcome=2)
    assert second.send(RELEASE, 2) == second.reached(1, ok=True) == -NOT_IN_COMMAND
    second.hold(False)
    assert served.service.job().outcome_number == 2
    second.hold()
    assert served.ended().outcome == "CANCELED"
    check_shown(second, state=HELD, outcome=CANCELED, holding=True, on_hold=False)
    check_shown(second, answer_job=False)  # of what was held there is no answer
    assert served.grip_n > 1.0
    assert first.send(RELEASE, 2) == 2
    assert served.ended().outcome == "SUCCEEDED"


def test_a_pressed_button_keeps_the_cell_on_hold(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    host.hold(True)
    assert served.service.held_by == (host.name,)
    check_shown(host, on_hold=True)
    for request in (IDENTIFY, GRIP, Request(task="reset"), RELEASE):
        assert host.send(request, 1) == -ON_HOLD
        check_refusal(host, ON_HOLD)
    host.hold(False)
    check_shown(host, on_hold=False, state=IDLE, job=0)
    assert host.send(GRIP, 1) == 1


def test_a_silent_host_loses_the_lease_and_nothing_resumes(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    served.plugin.pause()
    assert host.send(IDENTIFY, 1) == 1
    served.pass_lease()
    assert (served.ended().outcome, served.grip_n > 1.0) == ("CANCELED", True)
    check_shown(host, state=HELD, outcome=CANCELED)
    assert served.service.job().fault_number == HELD_ON_REQUEST
    lease = served.service.lease.acquire("robot")
    assert host.acquire() == NOT_IN_COMMAND
    assert host.send(RELEASE, 2) == -NOT_IN_COMMAND
    served.service.lease.give_up(lease)
    assert host.acquire() == 0
    assert (served.state, served.grip_n > 1.0) == ("HELD", True)
    assert host.send(IDENTIFY, 2) == -NOT_ALLOWED
    assert host.send(RELEASE, 2) == 2
    # Lost between two jobs it changes nothing.
    assert host.send(GRIP, 3) == 3
    served.pass_lease()
    assert (served.service.snapshot().commander, served.state) == ("", "COMPLETE")
    assert served.grip_n > 1.0


def test_a_fault_is_a_number_until_it_is_cleared(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    served.plugin.pause()
    assert host.send(GRIP, 1) == 1
    for number, reboot in ((2, False), (3, True)):
        served.plugin.fail(ServoFault(1, 0x20, "overload"))
        check_shown(host, state=ABORTED, fault=109, needs_reset=False, holding=True, force_n=None)
        if number == 2:
            check_shown(host, outcome=FAILED, job_fault=109)
        assert host.send(IDENTIFY, number) == -NOT_ALLOWED
        assert host.send(Request(task="clear", reboot=reboot), number) == number
        assert served.plugin.asked[-1] == (Command.CLEAR, reboot)
        check_shown(host, fault=0, needs_reset=True)
    assert served.grip_n > 1.0


def test_a_recording_that_has_stopped_is_shown(connect: Connect) -> None:
    served, host = connect()
    served.plugin.stop_recording("No space left on device")
    check_shown(host, recording=True)


def test_poses_are_reached_or_refused(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    for number, ok in enumerate((True, False), start=1):
        found = served.ask_pose(Pose(x_m=0.001))
        check_shown(host, pose_seq=number)
        assert host.reached(number + 1, ok=ok) == -REFUSED
        assert host.reached(number, ok=ok) == 0
        assert found.result(LIMIT_S) is ok
        assert host.reached(number, ok=ok) == -REFUSED  # twice is not two poses
        check_shown(host, pose_seq=0)
