"""What every interface promises its hosts: lease, hold, refusals, kept part, parts, poses."""

import asyncio
import itertools
import json
import os
import socket
import struct
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import AsyncMock, MagicMock, Mock
from xmlrpc.client import ServerProxy

import pytest
from scipy.spatial.transform import Rotation

from cell.config.model import CellConfig
from cell.config.serve import ServeConfig
from cell.control.part import Part
from cell.control.plan import Keep, Pose
from cell.control.states import Command
from cell.errors import CellError
from cell.interfaces.access import BUSY_MAX, is_for_this_machine, may_connect, same_secret
from cell.interfaces.cli.commands.serve import report_until
from cell.interfaces.http_server import REQUEST_BYTES, HttpServer
from cell.interfaces.modbus.registers import COMMANDS, N_INPUT, N_TEXT, VALUES
from cell.interfaces.opening import open_interfaces, page_address, running, view_note, warnings
from cell.interfaces.xml_rpc import METHODS, ur_pose
from cell.service.service import RELEASE_KEY
from gripper.errors import ServoFault
from recognition.recognizer import UNKNOWN
from tests.cell.cells import small_config
from tests.cell.interfaces.hosts import HOSTS, NOT_IN_COMMAND, Client, Host, Plc, Request
from tests.cell.served import ROUND, Served, pause
from tests.waiting import LIMIT_S, until

IDENTIFY = Request(task="identify", max_grasps=2, force_n=6.0, keep=Keep.ALWAYS)
GRIP = Request(task="grip", force_n=3.0)
RELEASE = Request(task="release", key=RELEASE_KEY)
REFUSED, NOT_ALLOWED, CONFIG, HELD_ON_REQUEST, ON_HOLD = 513, 505, 501, 512, 515
IDLE, EXECUTE, ABORTED, HELD, COMPLETE = 4, 6, 9, 11, 17
SUCCEEDED, CANCELED, FAILED = 4, 5, 6


Connect = Callable[..., tuple[Served, Host]]


@pytest.fixture(params=HOSTS)
def connect(request: pytest.FixtureRequest, serve: Any, undo: ExitStack) -> Connect:
    """Return the maker of a served cell and a host of each interface; with a cell another host."""

    def make(served: Served | None = None) -> tuple[Served, Host]:
        name = request.param
        served = served or serve(name)
        return served, undo.enter_context(closing(HOSTS[name](served.interfaces)))

    return make


def check_values(host: Host, **expected: Any) -> None:
    """Check what an interface shows of these values."""
    values = expected | host.values()
    actual = {
        name: bool(values[name]) if isinstance(value, bool) else values[name]
        for name, value in expected.items()
    }
    assert actual == pytest.approx(expected)


def check_refusal(host: Host, number: int) -> None:
    refused, text = host.refusal()
    assert (refused, bool(text)) == (number, True)


def test_a_part_is_identified_verified_and_let_go_with_its_key_alone(connect: Connect) -> None:
    served, host = connect()
    check_values(host, state=IDLE, grip=0, holding=False, needs_reset=False, on_hold=False, fault=0)
    check_values(host, recording=False, job=0, outcome=0, pose_seq=0, answer_job=False, part=False)
    check_values(host, force_n=0.0, opening_mm=40.0)
    assert host.acquire() == 0
    assert host.send(IDENTIFY, 1) == host.repeat() == host.repeat() == 1  # done once
    (goal,) = served.plugin.asked
    assert (goal.force_n, goal.max_grasps, goal.keep) == (6.0, 2, "always")
    named = {"label": "ball", "label_id": 1, "probability": 0.9, "size_mm": 9.5}
    answer = named | {"answer_job": 1, "in_grip": True, "part": 1, "part_label_id": 1}
    check_values(host, state=COMPLETE, holding=True, job=1, outcome=SUCCEEDED, n_grasps=1, **answer)
    check_values(host, force_n=3.25, setpoint_n=3.25, opening_mm=9.5, temperature_c=31.0)
    check_values(host, force_age_s=0.005, frame_age_s=0.02)
    assert host.send(Request(task="verify"), 2) == 2
    for key in (0, 0x504F, 1):
        assert host.send(Request(task="release", key=key), 3) == -REFUSED
        check_refusal(host, REFUSED)
    assert served.grip_n > 1.0
    assert host.send(RELEASE, 3) == 3
    check_values(host, state=IDLE, holding=False, job=3, force_n=0.0, **answer)
    assert served.grip_n == 0.0
    assert host.send(Request(task="teach", label="box", max_grasps=5), 4) == 4
    assert (served.plugin.asked[-1].label, served.plugin.asked[-1].grasps) == ("box", 5)
    served.plugin.pause()
    assert host.send(IDENTIFY, 5) == 5
    check_values(host, job=5, answer_job=False)  # until the next identification begins
    served.plugin.go_on()
    assert host.send(IDENTIFY, 6) == -NOT_ALLOWED
    check_values(host, state=COMPLETE, answer_job=5)
    assert host.send(Request(task="shutdown"), 6) == 6
    unmeasured = ("force_n", "force_age_s", "setpoint_n", "opening_mm", "frame_age_s")
    check_values(host, state=2, temperature_c=None, **dict.fromkeys(unmeasured))


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
    check_values(host, state=IDLE, job=0)
    assert served.plugin.asked == []


def test_a_second_host_is_refused_and_may_hold(connect: Connect) -> None:
    served, first = connect()
    _, second = connect(served)
    assert first.acquire() == 0
    assert second.acquire() == NOT_IN_COMMAND
    served.plugin.pause()
    assert first.send(IDENTIFY, 1) == 1
    check_values(first, state=EXECUTE, outcome=2)
    assert second.send(RELEASE, 2) == second.reached(1, ok=True) == -NOT_IN_COMMAND
    second.hold(False)
    assert served.plugin.job().outcome_number == 2
    second.hold()
    assert served.ended().outcome == "CANCELED"
    check_values(second, state=HELD, outcome=CANCELED, holding=True, on_hold=False)
    check_values(second, answer_job=False)  # of what was held there is no answer
    assert served.grip_n > 1.0
    assert first.send(RELEASE, 2) == 2
    assert served.ended().outcome == "SUCCEEDED"


def test_a_pressed_button_keeps_the_cell_on_hold(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    host.hold(True)
    assert served.service.held_by == (host.name,)
    check_values(host, on_hold=True)
    for request in (IDENTIFY, GRIP, Request(task="reset"), RELEASE):
        assert host.send(request, 1) == -ON_HOLD
        check_refusal(host, ON_HOLD)
    host.hold(False)
    check_values(host, on_hold=False, state=IDLE, job=0)
    assert host.send(GRIP, 1) == 1


def test_a_silent_host_loses_the_lease_and_nothing_resumes(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    served.plugin.pause()
    assert host.send(IDENTIFY, 1) == 1
    served.pass_lease()
    assert (served.ended().outcome, served.grip_n > 1.0) == ("CANCELED", True)
    check_values(host, state=HELD, outcome=CANCELED)
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
    served.plugin.show(recording_fault="No space left on device")
    check_values(host, recording=True)
    for number, reboot in ((1, False), (3, True)):
        served.plugin.pause()
        assert host.send(GRIP, number) == number
        served.plugin.fail(ServoFault(1, "overload", bits=0x20))
        check_values(host, state=ABORTED, fault=109, needs_reset=False, holding=True, force_n=None)
        check_values(host, outcome=FAILED, job_fault=109)
        assert host.send(IDENTIFY, number + 1) == -NOT_ALLOWED
        assert host.send(Request(task="clear", reboot=reboot), number + 1) == number + 1
        assert served.plugin.asked[-1] == (Command.CLEAR, reboot)
        check_values(host, fault=0, needs_reset=True)
        assert served.grip_n > 1.0
        served.plugin.ready()


def test_poses_are_reached_or_refused(connect: Connect) -> None:
    served, host = connect()
    assert host.acquire() == 0
    for number, ok in enumerate((True, False), start=1):
        answer = served.ask_pose(Pose(x_m=0.001))
        check_values(host, pose_seq=number)
        assert host.reached(number + 1, ok=ok) == -REFUSED
        assert host.reached(number, ok=ok) == 0
        assert answer.result(LIMIT_S) is ok
        assert host.reached(number, ok=ok) == -REFUSED  # twice is not two poses
        check_values(host, pose_seq=0)


# -- Each part as hosts see it: once, and with all it has ------------------------------------------


def test_each_part_reaches_plc_robot_and_program_once(serve) -> None:
    served = serve("modbus", "xmlrpc", "http")
    plc = Plc(served.interfaces["modbus_port"])
    cell = ServerProxy(f"http://127.0.0.1:{served.interfaces['xmlrpc_port']}/RPC2")
    host = Client(served.interfaces)
    sent: list[dict[str, Any]] = []
    with cell, host.live("&parts_after=0") as link, closing(plc.link):
        for number, label, label_id in ((1, "ball", 1), (2, UNKNOWN, 0)):
            probability = 0.9 - 0.01 * number
            named = {"label": label, "label_id": label_id, "place": "tray", "place_id": 2 + number}
            probabilities = {label: probability, "nut": 1.0 - probability}
            known = {"probabilities": probabilities, "shape": ROUND}
            served.plugin.find(Part(number=number, task="sort", **known, **named))
            while len(sent) < number:
                message = json.loads(link.recv(LIMIT_S))
                if message.get("event") == "part":
                    sent.append(message["part"])
                else:  # the event comes first
                    assert len(message["shift"]["answers"]) <= len(sent)
            values = named | {"number": number, "probability": probability, "size_mm": 9.5}
            assert {name: sent[-1][name] for name in values} == values
            assert cell.part() == number
            for name, value in (named | {"probability": probability, "size": 9.5}).items():
                assert getattr(cell, f"part_{name}")(number) == value
            words = plc.part()
            assert words[:5] == [number, label_id, round(1e4 * probability), 950, 2 + number]
            for first, text in ((8, label), (24, "tray")):
                written = struct.pack(">16H", *words[first : first + 16])
                assert written.rstrip(b"\0").decode("ascii") == text
        assert sent == host.get("/api/state")["shift"]["answers"]
    with host.live(f"&parts_after=2&boot={host.get('/api/info')['boot'] + 1}") as link:
        assert json.loads(link.recv(LIMIT_S))["part"]["number"] == 1


# -- The tables of what hosts read and call, and a pose as URScript has it -------------------------


def test_no_two_values_or_commands_share_a_place_at_an_interface() -> None:
    numbers = [number for one in COMMANDS for number in one.numbers]
    n_of = {str: N_TEXT}
    registers = [value.register + n for value in VALUES for n in range(n_of.get(value.kind, 1))]
    assert max(registers) < N_INPUT
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
    pose = ur_pose(Pose(x_m=0.001, y_m=-0.002, rotation_rad=rotation, roll_rad=roll))
    assert (pose["x"], pose["y"], pose["z"]) == (0.001, -0.002, 0.0)
    vector = Rotation.from_rotvec([pose["rx"], pose["ry"], pose["rz"]])
    assert vector.approx_equal(Rotation.from_euler("xz", [roll, rotation]), atol=1e-12)


# -- Opening the interfaces, who may connect, and the address that a browser opens -----------------


HOLD = struct.pack(">HHHBBHH", 1, 0, 6, 1, 6, 7, 1)
CALL = b"<methodCall><methodName>hold</methodName></methodCall>\n"
HEAD = b"POST /RPC2 HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/xml\r\n"
HEAD += b"Content-Length: %d\r\n\r\n" % len(CALL)
PRESS = b"POST /api/hold HTTP/1.1\r\nHost: localhost\r\n\r\n"
INTERFACES = {
    "modbus": (HOLD, HOLD[:5]),
    "xmlrpc": (HEAD + CALL, HEAD[:40]),
    "http": (PRESS, PRESS[:-2]),
}
"""A whole request of each interface, and one that never ends."""


@pytest.fixture
def link(serve: Any, undo: ExitStack) -> Callable[..., socket.socket]:
    """Return what connects to an interface from an address of this machine."""
    number = itertools.count()

    def connect(port: int, host: str) -> socket.socket:
        pause(next(number))
        return undo.enter_context(socket.create_connection(("127.0.0.1", port), 20.0, (host, 0)))

    return connect


def answered(link: socket.socket, request: bytes) -> bytes:
    """Send a request and return its answer; empty for none."""
    with suppress(ConnectionError):
        link.sendall(request)
        return link.recv(4096)
    return b""


LETS_IN = {"modbus": "modbus.protocol", "xmlrpc": "http_server", "http": "http_server"}
"""Module of each interface that asks who may connect."""


@pytest.mark.parametrize("interface", INTERFACES)
def test_other_hosts_are_refused(serve, link, monkeypatch, interface) -> None:
    port = serve(interface).interfaces[f"{interface}_port"]
    monkeypatch.setattr(f"cell.interfaces.{LETS_IN[interface]}.may_connect", lambda *_: False)
    answer = answered(link(port, "127.0.0.1"), INTERFACES[interface][0])
    assert answer.startswith(b"HTTP/1.1 403 ") if interface != "modbus" else not answer


@pytest.mark.parametrize("interface", INTERFACES)
def test_one_address_with_all_places_keeps_no_other_out(serve, link, interface) -> None:
    request, half = INTERFACES[interface]
    port = serve(interface, serve__request_timeout_s=60.0).interfaces[f"{interface}_port"]
    quiet, heard = link(port, "127.0.0.2"), link(port, "127.0.0.1")
    assert answered(heard, request)
    for _ in range(BUSY_MAX + 10):
        with suppress(ConnectionError):
            link(port, "127.0.0.1").sendall(half)
    for _ in range(BUSY_MAX):  # says nothing at all
        link(port, "127.0.0.4")
    assert answered(link(port, "127.0.0.3"), request)
    assert answered(quiet, request)  # has kept its place, though it never said a word
    assert answered(link(port, "127.0.0.1"), request)
    if interface != "http":  # which ends an idle connection after 5 s
        assert answered(heard, request)  # of a crowd those that were heard stay


@pytest.mark.parametrize("interface", INTERFACES)
def test_half_sent_requests_leave_within_their_time(serve, link, interface) -> None:
    _, half = INTERFACES[interface]
    port = serve(interface, serve__request_timeout_s=0.2).interfaces[f"{interface}_port"]
    links = [link(port, "127.0.0.1") for _ in range(8)]
    for one in links:
        one.sendall(half)
    for one in links:
        with suppress(ConnectionError):
            assert one.recv(1) == b""


@pytest.mark.parametrize("interface", INTERFACES)
def test_torn_requests_change_nothing(serve, link, interface) -> None:
    """The last byte is the end of a line: without it the call is whole, and the request is not."""
    request, _ = INTERFACES[interface]
    served = serve(interface)
    served.plugin.pause()
    served.service.start(served.service.lease.acquire("host"), {"task": "grip", "force_n": 3.0})
    port = served.interfaces[f"{interface}_port"]
    for cut in (*range(0, len(request), 7), len(request) - 1):
        with suppress(ConnectionError), link(port, "127.0.0.1") as torn:
            torn.sendall(request[:cut])
    assert not served.plugin.job().terminal
    assert answered(link(port, "127.0.0.1"), request)
    assert served.ended().outcome == "CANCELED"


@pytest.mark.parametrize("header", [b"\0\1\0\1\0\6\1", b"\0\1\0\0\0\1\1", b"\0\1\0\0\1\0\1"])
def test_what_is_no_modbus_is_closed_at_once(serve, link, header: bytes) -> None:
    port = serve("modbus").interfaces["modbus_port"]
    assert answered(link(port, "127.0.0.1"), header + b"\3\0\0\0\1") == b""


# -- who may connect ---------------------------------------------------------------------------


THIS_MACHINE = ("127.0.0.1", "::1", "::ffff:127.0.0.1")


def test_hosts_are_this_machine_and_those_allowed() -> None:
    config = small_config(
        serve__listen="0.0.0.0", serve__allow=["192.168.1.10", "10.1.0.0/16", "fd00::/8"]
    ).serve
    for host in (*THIS_MACHINE, "192.168.1.10", "::ffff:192.168.1.10", "10.1.2.3", "fd12::3"):
        assert may_connect(host, config), host
    for host in ("192.168.1.11", "10.2.0.1", "fe80::1%eth0"):
        assert not may_connect(host, config), host


REACHED = "192.0.2.1"
"""Address that the connection has reached."""
OF_THIS_MACHINE = (
    *("localhost", "LocalHost.:5021", "127.9.9.9:1", "[::1]:5021", socket.gethostname()),
    *(f"{REACHED}:5021", "cell.lan", "10.0.0.7"),
)
OF_OTHERS = (
    *("192.0.2.2", "evil.example", "evil.cell.lan", "cell.lan.evil.example"),
    *("localhost.evil.example", "localhost:5021:evil", "127.0.0.1@evil.example"),
    *("127.1", "", "[::1", "localhost\n"),
)


@pytest.mark.parametrize("host", OF_THIS_MACHINE + OF_OTHERS)
def test_requests_name_this_machine(host) -> None:
    config = small_config(serve__hosts=["cell.lan", "10.0.0.7"]).serve
    assert is_for_this_machine([host], REACHED, config) is (host in OF_THIS_MACHINE)
    assert not is_for_this_machine([host, host], REACHED, config)
    assert not is_for_this_machine([], REACHED, config)


@pytest.mark.parametrize("given", ["", "\ud800", "a\udfff", "\u00fc" * 16, "\0", "secret "])
def test_no_other_text_is_the_secret(given: str) -> None:
    assert not same_secret(given, "secret")
    assert same_secret("secret", "secret")


# -- Opening the interfaces: what keeps one from it, and what is warned of -------------------------


def test_interfaces_that_cannot_be_opened_say_why(serve, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for name, content in {"bad": b"+" * 20, "long": b"x" * 65, "short": b"short"}.items():
        (tmp_path / name).write_bytes(content)
    for interface, key, file, says in (
        ("http", "token_file", "missing", r"cannot read token or secret .*missing"),
        ("modbus", "secret_file", "pipe", "pipe: not a plain file"),
        ("http", "token_file", "pipe", "pipe: not a plain file"),
        ("http", "tls_key", "pipe", "pipe: not a plain file"),
        ("http", "tls_key", "missing", r"cannot read serve\.tls_key .*missing: No such file"),
        ("http", "tls_key", "bad", "bad must be PEM files of one certificate and its key"),
        ("xmlrpc", "secret_file", "bad", "no other characters"),
        ("modbus", "secret_file", "long", "at most 64 characters"),
        ("http", "token_file", "short", "at least 16 letters"),
    ):
        more = {"serve__tls_certificate": str(tmp_path / "bad")} if key == "tls_key" else {}
        with pytest.raises(CellError, match=says):
            serve(interface, **more, **{f"serve__{key}": str(tmp_path / file)})


def test_an_address_for_others_is_warned_of(serve) -> None:
    assert warnings(serve("modbus", "xmlrpc", "http").service) == ()
    others = {"serve__listen": "0.0.0.0", "serve__allow": ["192.0.2.1"]}
    modbus, http = warnings(serve(serve__modbus_port=0, serve__http_port=0, **others).service)
    assert "Modbus and XML-RPC authenticate nobody: any program on 192.0.2.1" in modbus
    assert "without TLS" in http
    assert warnings(serve(**others).service) == ()


@pytest.mark.parametrize("interface", ["modbus", "xmlrpc", "http"])
def test_a_taken_port_names_the_key_that_sets_another(serve, interface: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port, key = taken.getsockname()[1], f"serve__{interface}_port"
        ports = {f"serve__{name}_port": None for name in ("modbus", "xmlrpc", "http")}
        served = serve(**ports | {key: port})
        complaint = f"127.0.0.1:{port} .*set serve.{interface}_port to another port"
        with pytest.raises(CellError, match=complaint), open_interfaces(served.service):
            pass


def test_an_interface_that_dies_is_a_problem_and_its_error_is_shown(serve, caplog) -> None:
    service, over = serve().service, threading.Event()
    idle = SimpleNamespace(serve=lambda: asyncio.to_thread(over.wait), end=over.set)
    broken = SimpleNamespace(serve=AsyncMock(side_effect=OSError("no more files")), end=Mock())
    with running(service, {"modbus_port": broken, "http_port": idle}):
        until(lambda: "serve.modbus_port has ended" in service.problem)
    assert "no more files" in caplog.text


def test_a_program_with_a_problem_stops_its_job_and_feeds_no_watchdog(serve, capsys) -> None:
    served = serve("modbus")
    lease = served.service.lease.acquire("host")
    served.plugin.pause()
    served.service.start(lease, {"task": "identify"})
    reports: list[tuple[str, bool]] = []
    manager = SimpleNamespace(report=lambda text, *, working: reports.append((text, working)))
    turns = iter([True, True, False, False, True])

    def wait(_time_s: float) -> bool:
        """Have a cell that works in some turns."""
        served.plugin.working = next(turns, None)
        return served.plugin.working is None

    report_until(SimpleNamespace(wait=wait), served.service, manager)  # type: ignore[arg-type]
    assert [working for _, working in reports] == [True, True, False, False, True]
    assert reports[2][0].startswith("the thread of the cell hangs")
    assert "stopped because the thread of the cell hangs" in served.ended().error
    assert " ".join(capsys.readouterr().err.split()).count("the thread of the cell hangs") == 1


def test_a_host_may_take_its_time_for_a_pose(serve) -> None:
    served = serve()
    served.plugin.working = False  # the thread of the cell waits for the host
    assert served.service.problem
    reached = served.ask_pose(Pose())
    assert served.service.problem == ""
    served.service.pose_reached(served.service.lease.acquire("host"), 1)
    assert reached.result(LIMIT_S) is True


# -- The address of the page: one that a browser opens, here and elsewhere -------------------------


TLS = {"tls_certificate": "c", "tls_key": "k"}


@pytest.mark.parametrize(
    ("listen", "allow", "more", "address", "note"),
    [
        ("127.0.0.1", (), {}, "http://127.0.0.1:7", "set serve.listen"),
        ("::1", (), TLS, "https://[::1]:7", "set serve.listen"),
        ("10.0.0.3", ("10.0.0.0/8",), {}, "http://10.0.0.3:7", ""),
        ("0.0.0.0", ("10.0.0.0/8",), {"hosts": ("cell3.lan",)}, "http://cell3.lan:7", ""),
        ("0.0.0.0", ("127.0.0.1",), {}, f"http://{socket.gethostname()}:7", "set serve.hosts"),
    ],
)
def test_the_address_of_the_page_suits_a_browser(*, listen, allow, more, address, note) -> None:
    config = CellConfig(serve={"listen": listen, "allow": allow} | more).serve
    assert page_address({"http_port": 7, "token": "t"}, config) == f"{address}/#token=t"
    assert page_address({"modbus_port": 7}, config) is None
    assert note in view_note(config)
    assert bool(note) is bool(view_note(config))


def test_the_address_for_others_is_that_of_this_machine_on_their_way(monkeypatch) -> None:
    link = MagicMock()
    link.__enter__.return_value = link
    link.connect.side_effect = [OSError("no route"), None] * 2
    link.getsockname.return_value = ("192.168.7.3", 40000)
    monkeypatch.setattr(socket, "socket", lambda *_family: link)
    allow = ("10.0.0.0/8", "192.168.7.0/24")
    config = CellConfig(serve={"listen": "0.0.0.0", "allow": allow}).serve
    browsed = page_address({"http_port": 7, "view_token": "v"}, config, "view_token")
    assert (browsed, view_note(config)) == ("http://192.168.7.3:7/#token=v", "")
    asked = [call.args[0][0] for call in link.connect.call_args_list]
    assert asked == ["10.128.0.0", "192.168.7.128"] * 2


# -- What the server refuses before every HTTP application, and when it answers --------------------


@pytest.mark.parametrize(
    ("length", "host", "wanted"),
    [
        (2, b"evil.example", ["read", "read", 403]),
        (0, b"evil.example", [403]),
        (REQUEST_BYTES + 1, b"127.0.0.1", [413]),
    ],
)
def test_a_refusal_follows_the_body_unless_it_is_too_long(length, host, wanted) -> None:
    order: list[Any] = []

    async def receive() -> dict[str, Any]:
        order.append("read")
        return {"type": "http.request", "body": b"x", "more_body": len(order) == 1}

    async def send(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            order.append(message["status"])

    headers = [(b"host", host), (b"content-length", str(length).encode())]
    ends = {"client": ("127.0.0.1", 1), "server": ("127.0.0.1", 2)}
    app = AsyncMock(side_effect=AssertionError("the request has passed"))
    with closing(HttpServer(app, ServeConfig(), 0)) as server:
        asyncio.run(server({"type": "http", "headers": headers} | ends, receive, send))
    assert order == wanted
