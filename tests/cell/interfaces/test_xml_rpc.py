"""The cell over XML-RPC, with the standard library's client and the example's robot program."""

import ast
import builtins
import dis
import gzip
import re
import socket
import threading
from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock
from urllib.parse import urlsplit
from xmlrpc.client import Fault, ProtocolError, ServerProxy, dumps, loads

import pytest

from cell.control.plan import Pose
from cell.errors import TooFewGrasps
from cell.interfaces.xml_rpc import METHODS, ur_pose
from gripper.errors import PartSlipped
from tests.cell.interfaces.hosts import Client
from tests.cell.served import Served
from tests.values import raising
from tests.waiting import until

SCRIPT = Path(__file__).parents[3] / "docs" / "examples" / "tactile_cell.script"


_PYTHON = (
    (r"^global (\w+) =", r"\1 ="),
    (r"^( +)global (\w+) =", r'\1globals()["\2"] ='),
    (r"^ *end$", ""),
    (r"^thread ", "def "),
    (r"\bp\[", "["),
    (r"\b(run|kill) (\w+)(\(\))?$", r"\1(\2)"),
    (r"\bwhile True:", "while not over():"),
)
"""What URScript alone has, and what it is in Python."""


class Robot:
    """A robot that runs the script: its motions and messages are noted."""

    def __init__(self, address: str) -> None:
        self.moves: list[Any] = []
        self.messages: list[Any] = []
        self.slept: Callable[[float], None] = lambda _s: None
        self._address = urlsplit(address)
        self._sockets: dict[str, socket.socket] = {}
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._links: list[ServerProxy] = []
        self.names: dict[str, Any] = {
            "rpc_factory": self._rpc,
            "movel": lambda pose, **_limits: self.moves.append(pose),
            "pose_trans": lambda base, offset: (base, offset),
            "pose_inv": lambda pose: pose,
            "textmsg": lambda *text: self.messages.append(text),
            "sleep": self._sleep,
            "socket_open": self._socket_open,
            "socket_close": lambda name: self._sockets.pop(name).close(),
            "run": self._run,
            "kill": lambda _heart: self._over.set(),
            "over": self._over.is_set,
        }
        text = SCRIPT.read_text()
        for script, python in _PYTHON:
            text = re.sub(script, python, text, flags=re.MULTILINE)
        for statement in ast.parse(text).body:
            exec(compile(ast.Module([statement], []), str(SCRIPT), "exec"), self.names)
            if isinstance(statement, ast.FunctionDef):  # it uses what lines above it declare
                code = dis.get_instructions(self.names[statement.name])
                used = {one.argval for one in code if one.opname == "LOAD_GLOBAL"}
                assert used <= {*self.names, *dir(builtins)}, statement.name
        self.names |= {"ADDRESS": address, "HOST": "127.0.0.1", "PORT": self._address.port}

    def sort_parts(self, parts: int) -> int:
        return self.names["sort_parts"](parts)

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for link in self._links:
            link("close")()

    def _sleep(self, time_s: float) -> None:
        self.slept(time_s)
        self._over.wait(0.01)

    def _socket_open(self, host: str, port: int, name: str) -> bool:
        try:
            self._sockets[name] = socket.create_connection((host, port), 20.0)
        except OSError:
            return False
        return True

    def _run(self, thread: Callable[[], None]) -> None:
        self._threads.append(threading.Thread(target=thread, daemon=True))
        self._threads[-1].start()

    def _rpc(self, kind: str, _address: str) -> Mock:
        assert kind == "xmlrpc"
        self._links.append(ServerProxy(self._address.geturl()))
        return Mock(wraps=self._links[-1])


@pytest.fixture
def connect(serve: Any, undo: ExitStack) -> Callable[..., tuple[Served, Any]]:
    """Return the maker of a served cell and a client: by default the library's own one."""

    def make(client: Callable[[str], Any] = ServerProxy, **changes: Any) -> tuple[Served, Any]:
        served = serve("xmlrpc", **changes)
        return served, undo.enter_context(client(address(served)))

    return make


def address(served: Served) -> str:
    return f"http://127.0.0.1:{served.interfaces['xmlrpc_port']}/RPC2"


def post(served: Served, body: bytes, **headers: str) -> tuple[int, bytes]:
    host = Client({"http_port": served.interfaces["xmlrpc_port"], "token": ""})
    given = {"Content-Type": "text/xml"} | headers
    return host.send("POST", "/RPC2", body, token=None, **given)[:2]


def test_a_verification_has_its_answer_and_a_lease_its_end(connect) -> None:
    served, cell = connect()
    lease = cell.acquire("robot")
    assert cell.alive(lease) == 0
    served.plugin.pause()
    job = cell.identify(lease, 1.0, 6.0, 1)  # as a robot computes them
    assert cell.same(job) == -1
    served.plugin.go_on()
    assert (cell.same(job), cell.same(cell.verify(lease))) == (-513, 1)
    assert (cell.give_up(lease), cell.alive(lease)) == (0, -514)


def test_no_method_raises_whatever_it_is_given(connect) -> None:
    served, cell = connect()
    types = (int, float, bool, str, dict)
    for name in METHODS:
        for arguments in ((), (1,), ("x",), (1, 2), (1, "x", 2.0), (1, 1, 1.0, True), (1,) * 7):
            assert isinstance(getattr(cell, name)(*arguments), types), (name, arguments)
    state = dumps((), "state").encode()
    kind = {"Content-Type": "Text/XML; charset=utf-8", "Host": "[::1]:5021"}
    assert loads(post(served, state, **kind)[1])[0] == (4,)
    assert cell.identify(1, 1, 1.0, True) == -514
    for wrong in ((1, 1), ("x", 1, 1.0, True), (1, {}, 1.0, True), (1, 1.5, 1.0, True)):
        assert cell.identify(*wrong) == -501
    served.service.stop = (stops := []).append
    assert (cell.hold("x"), stops) == (-501, ["by XML-RPC 127.0.0.1"])
    assert cell.last_refusal().startswith("501: latch is 'x'; write a number")
    assert cell.job_state(7) == -513
    assert (cell.label(7), cell.probability(7)) == ("", -513.0)
    with pytest.raises(Fault, match="not supported"):
        cell.nothing()
    served.service.lease.alive = raising(TypeError("a defect"))
    assert cell.alive(1) == -599


def test_the_last_refusal_of_each_address_says_why(connect) -> None:
    served, cell = connect()
    assert cell.last_refusal() == ""
    lease = cell.acquire("robot")
    missing = "box has 1 grasp"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(served.plugin, "start", raising(TooFewGrasps(missing)))
        assert cell.teach(lease, "box", 1) == -519
    refusal = cell.last_refusal()
    assert refusal.startswith(f"519: {missing}")
    assert refusal.endswith("Teach more grasps.")
    assert cell.job_state(cell.shutdown(lease)) == 4
    assert cell.force() == -516.0  # no refusal: nothing is measured
    assert cell.last_refusal() == refusal
    job = cell.reset(lease)
    assert (cell.job_state(job), cell.state(), cell.job_text(job)) == (4, 4, "")


def test_methods_are_listed_with_help(connect) -> None:
    _, cell = connect()
    assert set(METHODS) < set(cell.system.listMethods())
    assert cell.system.methodHelp("force").startswith("Return the grip force in N; -516")


def test_the_next_pose_is_one_of_ur(connect) -> None:
    served, cell = connect()
    assert cell.next_pose() == dict.fromkeys(("x", "y", "z", "rx", "ry", "rz"), 0.0)
    pose = Pose(x_m=0.001, rotation_rad=0.4)
    served.ask_pose(pose)
    assert cell.next_pose() == pytest.approx(ur_pose(pose))


# -- the example -------------------------------------------------------------------------------


@pytest.fixture
def robot(connect: Any) -> Callable[..., tuple[Served, Robot]]:
    """Return the maker of a served cell and a robot with the program of the example."""
    return partial(connect, lambda url: closing(Robot(url)))


def places(robot: Robot) -> list[int]:
    """Return the numbers of the places that the robot has moved to."""
    known = robot.names["PLACES"]
    return [known.index(move) for move in robot.moves if move in known]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "cell", "n_parts"),
    [("simulated", None, 2), pytest.param("callback", {}, 1, marks=pytest.mark.slow)],
    ids=["stub", "cell whose host moves"],
)
def test_the_robot_program_of_the_example_sorts_parts(robot, kind, cell, n_parts) -> None:
    served, ur = robot(cell=cell, positioner__kind=kind)
    assert ur.sort_parts(n_parts) == n_parts
    assert ur.messages == []
    jobs = list(served.plugin.jobs())
    assert [job.task for job in jobs] == ["identify", "verify", "release"] * n_parts
    assert ur.names["alive_line"].alive.called
    assert places(ur) == [job.part.label_id for job in jobs[::3]]
    assert ur.names["cell"].pose_reached.called is (kind == "callback")
    assert (served.state, served.grip_n) == ("IDLE", 0.0)
    assert served.service.snapshot().commander == ""


@pytest.mark.parametrize(
    ("answer", "expected", "released"),
    [
        ("label_id 3", [0], 1),  # a label without a place
        ("label_id -513", [0], 1),
        ("label_id 2", [2], 1),
        ("same 0", [1, 0], 1),  # another part is let go at no place
        ("same -514", [1], 0),  # what no call can tell stays held
    ],
)
def test_the_robot_program_of_the_example_lets_each_part_go_at_its_place_alone(
    robot, answer, expected, released
) -> None:
    served, ur = robot()
    method, value = answer.split()
    getattr(ur.names["cell"], method).return_value = int(value)
    assert ur.sort_parts(1) == released
    assert (places(ur), served.grip_n == 0.0) == (expected, bool(released))


def test_the_robot_program_of_the_example_keeps_a_part_that_slips(robot) -> None:
    served, ur = robot()
    move = ur.names["movel"]

    def carry(pose: Any, **limits: Any) -> None:
        move(pose, **limits)
        if pose in ur.names["PLACES"]:
            served.plugin.fail(PartSlipped("the part slips"))

    ur.names["movel"] = carry
    assert ur.sort_parts(1) == 0
    assert (served.grip_n > 1.0, served.state) == (True, "ABORTED")
    assert ur.messages[-1][1].startswith("505: the cell is ABORTED; allowed: clear")


def test_the_robot_program_of_the_example_waits_for_the_lease_it_left_behind(robot) -> None:
    served, ur = robot()
    served.service.lease.acquire("ur")
    ur.slept = lambda time_s: setattr(served.clock, "now_s", served.clock.now_s + 20 * time_s)
    assert ur.sort_parts(1) == 1


def test_the_robot_program_of_the_example_stops_where_another_commands(robot) -> None:
    served, ur = robot()
    served.service.lease.acquire("PLC")
    assert ur.sort_parts(1) == -1
    ((said, why),) = ur.messages
    assert (said, why.startswith("514: 'PLC' is in command")) == ("not in command: ", True)
    assert ur.moves == []


def test_the_robot_program_of_the_example_says_that_the_cell_is_gone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        gone = f"http://127.0.0.1:{free.getsockname()[1]}/RPC2"
    ur = Robot(gone)
    assert ur.sort_parts(1) == -1
    ur.close()
    assert ur.messages == [("the cell cannot be reached at ", gone)]


def test_the_robot_program_of_the_example_ends_with_the_part_where_it_is_held(robot) -> None:
    served, ur = robot()
    served.plugin.pause()

    def hold() -> None:
        until(lambda: served.plugin.job().number)
        served.service.stop()

    operator = threading.Thread(target=hold)
    operator.start()
    assert ur.sort_parts(1) == 0
    operator.join()
    ((said, why),) = ur.messages
    assert (said, why.startswith("Release, then go on. stopped")) == ("job: ", True)
    assert (served.state, served.grip_n > 1.0) == ("HELD", True)


# -- secrets -----------------------------------------------------------------------------------


def test_who_commands_names_the_secret_where_there_is_one(connect, tmp_path) -> None:
    (tmp_path / "secret").write_text("sixteen-letters~\n")
    served, cell = connect(serve__secret_file=str(tmp_path / "secret"))
    for given in (("robot",), ("wrong", "robot"), ("", "robot"), (1, "robot"), ("\u00fc" * 16,)):
        assert cell.acquire(*given) == -513
    assert served.service.snapshot().commander == ""
    assert cell.hold() == 0
    assert cell.alive(cell.acquire("sixteen-letters~", "robot")) == 0
    assert served.service.snapshot().commander == "robot"


# -- bad input ---------------------------------------------------------------------------------


DOCTYPE = "<!DOCTYPE a [<!ENTITY b 'b'>]><methodCall><methodName>state</methodName></methodCall>"
ENCODINGS = ("utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig")
TYPED = '<?xml version="1.0" encoding="{}"?>' + DOCTYPE


def test_what_is_no_call_or_could_grow_is_refused(connect) -> None:
    served, cell = connect()
    encoded = [TYPED.format(one).encode(one) for one in (*ENCODINGS, "cp037")]
    packed = gzip.compress(dumps((), "state").encode(), mtime=0)
    latin = dumps(("ü",), "acquire").encode("latin-1")
    served.plugin.pause()
    cell.grip(cell.acquire("robot"), 3.0)
    for body in (DOCTYPE.encode(), *encoded, b"\0" * 50, latin):
        assert post(served, body)[0] == 501, body
    assert post(served, packed, **{"Content-Encoding": "gzip"})[0] == 501
    for headers in (  # of a web page
        {"Origin": "http://127.0.0.1"},
        {"Host": "evil.example:5021"},
        {"Content-Type": "text/plain"},
        {"Content-Type": "application/x-www-form-urlencoded"},
        {"Content-Type": ""},
    ):
        assert post(served, dumps((), "hold").encode(), **headers)[0] == 403, headers
    for body in (b"", b"<", b"<methodCall>", b"{}"):
        status, answer = post(served, body)
        assert status == 200
        with pytest.raises(Fault):
            loads(answer)
    elsewhere = ServerProxy(address(served).replace("RPC2", "api"))
    with elsewhere, pytest.raises(ProtocolError, match="404"):
        elsewhere.hold()
    assert not served.plugin.job().terminal
