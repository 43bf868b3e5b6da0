"""Requests to a running cell, on its socket and in words of the hands."""

import json
import re
import socket
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulator.cell import SimulatedCell
from simulator.devices import CellDevices
from simulator.errors import PartGripped, SimulatorError, SimulatorSettingsError
from simulator.faults.injector import FaultInjector
from simulator.realtime.hands import HELP, Hands
from simulator.realtime.requests import CellRequests
from simulator.realtime.socket_server import CLIENT_LIMIT, LINE_LIMIT, PositionerServer
from simulator.settings import RecordedGrasp, SimulatorSettings
from tactile.layout import pinch_layout


@pytest.fixture
def devices() -> CellDevices:
    cell = CellDevices(SimulatorSettings())
    cell.unit.connect(lambda ready_s, _can_id, _messages: ready_s)
    cell.unit.advance(0.1)
    return cell


@pytest.fixture
def injector(devices: CellDevices) -> FaultInjector:
    return FaultInjector(devices, 0.1)


@pytest.fixture
def requests(devices: CellDevices, injector: FaultInjector) -> CellRequests:
    return CellRequests(devices, injector)


def test_objects_are_placed_and_the_reply_says_where_they_rest(requests, devices) -> None:
    reply = requests({"place": "box", "pose": {"x_m": 0.001, "roll_rad": 1.5}})
    assert reply["pose"] == {
        "x_m": 0.001,
        "y_m": 0.0,
        "z_m": 0.0,
        "rotation_rad": 0.0,
        "roll_rad": pytest.approx(np.pi / 2),
    }
    state = requests({"state": True})
    assert state["placed"] == "box"
    assert state["aperture_m"] == pytest.approx(0.03)
    assert state["control_unit"] == "PRE-OPERATIONAL"
    assert json.loads(json.dumps(state)) == state
    assert requests({"place": "sphere:diameter=8mm"})["pose"]["x_m"] == 0.0
    assert requests({"remove": True}) == {"removed": True}
    assert devices.physical.placed is None


def test_objects_get_names_and_lie_beside_their_pose(requests, devices) -> None:
    assert requests({"check": "nothing"}) == {"known": True}
    with pytest.raises(SimulatorSettingsError, match="no object 'mug'; there are "):
        requests({"check": "mug"})
    assert "mug" in requests({"define": "mug", "shape": "sphere:diameter=8mm"})["objects"]
    assert requests({"place": "mug"})["pose"]["x_m"] == 0.0
    requests({"place": "mug", "offset": {"x_m": 0.001}})
    assert requests({"place": "mug", "pose": {"x_m": 0.002}})["pose"]["x_m"] == 0.003
    assert requests({"state": True})["offset"]["x_m"] == 0.001
    devices.physical._force_n = (1.0, 1.0)
    for label in ("mug", "nothing"):
        with pytest.raises(PartGripped, match="release it first"):
            requests({"place": label})
    devices.physical._force_n = (0.0, 0.0)
    requests({"place": "nothing"})
    assert requests({"state": True})["placed"] is None


def test_recorded_grasps_are_played_by_number() -> None:
    grasp = RecordedGrasp(counts=np.zeros((4, 156), np.uint16), aperture_m=np.full(4, 0.02))
    devices = CellDevices(SimulatorSettings(layout=pinch_layout(), grasps=(grasp,)))
    requests = CellRequests(devices, FaultInjector(devices, 0.0))
    assert requests({"play": 0}) == {"frames": 4}
    assert requests({"state": True})["frames_left"] == 4
    for request in ({"play": 1}, {"play": "0"}, {"place": "ball"}):
        with pytest.raises(SimulatorError):
            requests(request)


@pytest.mark.parametrize(
    "request_",
    [
        {},
        {"place": "ball", "remove": True},
        {"dance": True},
        {"place": 3},
        {"place": "teapot"},
        {"place": "mesh:file=/etc/passwd"},
        {"place": "ball", "pose": [1]},
        {"place": "ball", "pose": {"x_mm": 1.0}},
        {"place": "ball", "pose": {"x_m": "1"}},
        {"place": "ball", "pose": {"x_m": float("nan")}},
        {"place": "ball", "pose": {"x_m": 1.0}},
        {"place": "ball", "pose": {"y_m": 1e308}},
        {"place": "ball", "pose": {"y_m": 10**400}},
        {"place": "ball", "offset": {"x_m": 9.0}},
        {"place": "ball", "offset": {"w": 1}},
        {"place": "ball", "offset": 3},
        {"define": "ball", "shape": "box"},
        {"define": "nothing", "shape": "box"},
        {"define": "", "shape": "box"},
        {"define": "a", "shape": "mesh:file=a"},
        {"press": 10},
        {"press": ["finger0.tip"]},
        {"press": "finger2.tip"},
        {"press": "finger0.tip", "at": "left"},
        {"press": "finger0.tip", "at": [["left"]]},
        {"press": "finger0.tip", "force_n": -1.0},
        {"hand": {"3": 0.01}},
        {"hand": {"1": "wide"}},
        {"hand": {}},
        {"hand": 7},
        {"remove": False},
        {"state": 1},
        {"kinds": 1},
        {"play": 0},
        {"inject": 5},
        {"inject": "can.lost"},
        {"inject": "can.loss=1.5"},
        {"inject": "servo9.off"},
        {"inject": "taxels.stuck_at=408:0"},
        {"inject": "servos.delayed=" + "9" * 400},
        {"clear": None},
        {"clear": "can.loss"},
        {"fault": "can.drop_rate", "value": 0.5},
        {"unplug": "can"},
    ],
    ids=str,
)
def test_requests_that_make_no_sense_are_refused_and_change_nothing(
    requests, devices, request_
) -> None:
    before = repr((devices.faults.can, devices.faults.unit, devices.faults.servo_wire))
    with pytest.raises(SimulatorError):
        requests(request_)
    assert repr((devices.faults.can, devices.faults.unit, devices.faults.servo_wire)) == before
    assert devices.physical.placed is None


class Served:
    """A server and a way to ask it."""

    def __init__(self, path: Path) -> None:
        self.asked: list[dict[str, Any]] = []
        self.server = PositionerServer(path, self._handle)

    def _handle(self, request: dict[str, Any]) -> dict[str, Any]:
        self.asked.append(request)
        if "refuse" in request:
            raise SimulatorSettingsError("no such thing")
        return {"n": len(self.asked)}

    def poll(self) -> None:
        for _ in range(3):
            self.server.poll(self.server.filenos())

    def connect(self) -> socket.socket:
        client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        client.connect(str(self.server.path))
        client.settimeout(5.0)
        self.poll()
        return client


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    made = Served(tmp_path / "s")
    yield made
    made.server.close()


def test_each_request_is_answered_on_its_own_line(served) -> None:
    with served.connect() as client:
        client.sendall(b'{"a": 1}\n{"refuse": 1}\n\n{"b"')
        served.poll()
        assert client.recv(4096) == b'{"n": 1}\n{"error": "no such thing"}\n'
        client.sendall(b": 2}\n")
        served.poll()
        assert client.recv(4096) == b'{"n": 3}\n'
    served.poll()
    assert len(served.server.filenos()) == 1
    served.server.close()
    assert not served.server.path.exists()


def test_a_request_without_an_end_is_cut_off(served) -> None:
    with served.connect() as client:
        client.setblocking(False)
        sent = 0
        while sent <= LINE_LIMIT:
            sent += client.send(b"x" * 10_000)
            served.poll()
        client.settimeout(5.0)
        assert b"at most" in client.recv(4096)
        assert client.recv(4096) == b""


def test_a_client_that_is_gone_is_forgotten(served) -> None:
    client = served.connect()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.sendall(b'{"a": 1}\n')
    client.close()
    served.poll()
    assert len(served.server.filenos()) == 1


def test_only_so_many_clients_are_served(served) -> None:
    clients = [served.connect() for _ in range(CLIENT_LIMIT + 1)]
    served.poll()
    assert len(served.server.filenos()) == CLIENT_LIMIT + 1
    assert clients[-1].recv(1) == b""
    for client in clients:
        client.close()


def test_the_socket_belongs_to_its_owner_and_replaces_a_stale_one(tmp_path) -> None:
    path = tmp_path / "s"
    stale = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    stale.bind(str(path))
    stale.close()
    served = Served(path)
    assert path.stat().st_mode & 0o777 == 0o600
    served.server.close()


def test_faults_are_injected_and_cleared_by_their_text(requests, devices, injector) -> None:
    assert requests({"inject": "can.loss=0.5@50ms"}) == {"inject": "can.loss=0.5@50ms"}
    assert requests({"state": True})["faults"] == {"can.loss=0.5@50ms": None}
    injector.advance(0.2)
    assert devices.faults.can.drop_rate == 0.5
    began_s = requests({"state": True})["faults"]["can.loss=0.5@50ms"]
    assert began_s == pytest.approx(0.2)
    assert requests({"clear": "can.loss"}) == {"cleared": 1}
    assert devices.faults.can.drop_rate == 0.0


class At:
    """Hands at a cell in virtual time."""

    def __init__(self) -> None:
        self.cell = SimulatedCell()
        self._requests = CellRequests(self.cell.devices, self.cell.injector)
        self.do = Hands(self._requests, self.cell.clock.sleep).do

    @property
    def state(self) -> dict[str, Any]:
        return self._requests({"state": True})

    @property
    def fingers_mm(self) -> list[float]:
        return [round(1e3 * half_m) for half_m in self.state["fingers_m"]]


@pytest.fixture
def at() -> At:
    return At()


def test_fingers_are_moved_and_left(at: At) -> None:
    for words, fingers_mm in (
        ("close", [0, 0]),
        ("open finger 1", [0, 59]),
        ("open", [59, 59]),
        ("half", [30, 30]),
        ("block 12 mm", [6, 6]),
    ):
        assert at.do(words).startswith("finger 0 ")
        assert at.fingers_mm == fingers_mm, words
        assert not at.state["moved_by_hand"]


def test_what_is_between_the_fingers_and_on_the_pads(at: At) -> None:
    assert "between them: ball" in at.do("part")
    assert "between them: box;" in at.do("part box")
    assert "pressed: finger0.inner" in at.do("load finger0.inner 500 g")
    assert at.cell.world.taxel_force_n().sum() == pytest.approx(4.9, abs=0.01)
    assert at.do("lift").endswith("between them: box; pressed: no pad")
    assert at.cell.world.taxel_force_n().sum() == 0.0
    at.do("press finger1.tip")
    assert at.do("empty").endswith("between them: nothing; pressed: no pad")
    assert at.do("disconnect servo 2").endswith("disconnected: servo2")
    assert at.state["faults"].keys() == {"servo2.off"}
    at.do("connect 2")
    assert at.state["faults"] == {}
    assert at.do("help").endswith("finger1.side_b, finger1.tip")


@pytest.mark.parametrize(
    ("where", "row", "column"),
    [
        ("finger0.inner", 8, 2.0),
        ("finger0.inner tip left", 13.5, 3.5),
        ("finger1.inner near tip and right edge", 13.5, 3.5),
        ("finger0.inner base right", 2.5, 0.5),
        ("finger0.outer tip left", 13.5, 3.5),
        ("finger1.side_a tip right", 13.5, 1.5),
        ("finger0.side_b base left", 2.5, 1.5),
        ("finger0.tip left inside", 5, 1.5),
        ("finger1.tip left outside", 1, 0.5),
    ],
)
def test_a_fingertip_is_where_the_words_say(at: At, where: str, row: float, column: float) -> None:
    at.do(f"press {where}")
    layout = at.cell.settings.layout
    force_n = at.cell.world.taxel_force_n()
    number = [pad.name for pad in layout.pads].index(where.split(maxsplit=1)[0])
    pad = layout.pads[number]
    assert set(layout.taxel_pad[force_n > 1e-6]) == {number}
    of_pad = force_n[layout.taxels_of(number)].reshape(pad.rows, pad.columns) / force_n.sum()
    rows, columns = of_pad.sum(1) @ range(pad.rows), of_pad.sum(0) @ range(pad.columns)
    # Middle of a taxel: its number and a half.
    assert (rows + 0.5, columns + 0.5) == pytest.approx((row, column), abs=0.55)


def test_the_help_has_each_word_and_what_is_none_is_refused(at: At) -> None:
    words = re.findall(r"^([a-z]+) ", HELP, re.MULTILINE)
    assert at.do("") == at.do("help")
    for word in words:
        at.do("empty")
        at.do("open")
        plain = {"block": "block 9", "press": "press finger0.tip", "load": "load finger0.tip 9"}
        at.do(plain.get(word, f"{word} 1" if "connect" in word else word))
    for wrong in (
        "dance",
        "block",
        "block ten",
        "open 7",
        "block -3",
        "press finger0.inner up",
        "press 3",
    ):
        with pytest.raises(SimulatorError):
            at.do(wrong)
    with pytest.raises(SimulatorSettingsError, match="`help` lists all commands"):
        at.do("disconnect two")
