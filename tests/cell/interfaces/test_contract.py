"""What every interface promises its hosts: lease, hold, refusals, kept part, parts, poses."""

import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any
from xmlrpc.client import ServerProxy

import numpy as np
import pytest

from cell.control.part import Part
from cell.control.plan import Keep, Pose
from cell.control.states import Command
from cell.interfaces.modbus.registers import COMMANDS, VALUES
from cell.interfaces.xml_rpc import METHODS, ur_pose
from cell.service.service import RELEASE_KEY
from gripper.errors import ServoFault
from recognition.recognizer import UNKNOWN
from tests.cell.interfaces.hosts import HOSTS, NOT_IN_COMMAND, BlockPlc, Client, Host, Plc, Request
from tests.cell.served import ROUND, Served
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
    answer = named | {"answer_job": 1, "in_grip": True, "part": 1, "part_label_id": 1}
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
    assert served.plugin.job().outcome_number == 2
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
    assert served.plugin.job().fault_number == HELD_ON_REQUEST
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


# -- Each part as hosts see it: once, and with all it has ------------------------------------------


PLACES = ("ball", "box", "reject")


@pytest.mark.slow
def test_each_part_reaches_plc_robot_and_program_once(serve) -> None:
    served = serve("modbus", "xmlrpc", "http", serve__objects=["box", "ball"])
    plc = BlockPlc(Plc(served.interfaces["modbus_port"])).ready()
    cell = ServerProxy(f"http://127.0.0.1:{served.interfaces['xmlrpc_port']}/RPC2")
    host = Client(served.interfaces)
    sent: list[dict[str, Any]] = []
    with cell, host.live("&parts_after=0") as link, closing(plc.plc.link):
        for number, (label, label_id, place_id) in enumerate(
            (("ball", 2, 1), ("box", 1, 2), (UNKNOWN, 0, 3)), start=1
        ):
            place, probability = PLACES[place_id - 1], 0.9 - 0.01 * number
            part = Part(
                number=number,
                task="sort",
                label=label,
                label_id=label_id,
                probabilities={label: probability},
                shape=ROUND,
                place=place,
                place_id=place_id,
                rejected=place == "reject",
            )
            served.plugin.on_part(part, None)
            plc.cycle()
            names = {"label": label, "label_id": label_id, "place": place, "place_id": place_id}
            assert cell.part() == number
            for name, value in (names | {"probability": probability, "size": 9.5}).items():
                assert getattr(cell, f"part_{name}")(number) == value
            while len(sent) < number:
                message = json.loads(link.recv(LIMIT_S))
                if message.get("event") == "part":
                    sent.append(message["part"])
                else:  # the event comes first
                    assert len(message["shift"]["answers"]) <= len(sent)
            shown = names | {"number": number, "probability": probability, "size_mm": 9.5}
            assert {name: sent[-1][name] for name in shown} == shown
            assert plc.cycle()["NewPart"] is False
            assert plc.parts[number - 1 :] == [
                {
                    "Number": number,
                    "LabelId": label_id,
                    "Probability": round(1e4 * probability),
                    "Size": 950,
                    "Place": place_id,
                    "Label": label,
                    "PlaceName": place,
                }
            ]
        assert sent == host.get("/api/state")["shift"]["answers"]


# -- The tables of what hosts read and call, and a pose as URScript has it -------------------------


def test_no_two_values_or_commands_share_a_place_at_an_interface() -> None:
    numbers = [number for one in COMMANDS for number in one.numbers]
    registers = [one.register for one in VALUES]
    for places in (registers, numbers):
        assert len(places) == len(set(places))
    assert {one.name for one in COMMANDS} < set(METHODS)
    # Registers and commands of their own making.
    assert not set(registers) & {0, 1, 2, 5, 6, 7, 17, 18, 19, 20, 25, 26, 27, *range(32, 96)}
    assert not set(numbers) & {4, 40, 41}


@pytest.mark.parametrize(
    ("rotation", "roll"), [(0.0, 0.0), (0.4, 0.0), (0.0, -2.0), (3.0, 1.0), (-3.1, 3.1)]
)
def test_a_rotation_vector_rolls_first_then_turns(rotation: float, roll: float) -> None:
    found = ur_pose(Pose(x_m=0.001, y_m=-0.002, rotation_rad=rotation, roll_rad=roll))
    assert (found["x"], found["y"], found["z"]) == (0.001, -0.002, 0.0)
    vector = np.array([found["rx"], found["ry"], found["rz"]])
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle else vector
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turned = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    c, s, cr, sr = math.cos(rotation), math.sin(rotation), math.cos(roll), math.sin(roll)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    np.testing.assert_allclose(turned, about_z @ about_x, atol=1e-12)
