"""A cell on real terminals, driven step by step with a made-up time."""

import json
import math
import os
import re
import select
import signal
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import serial

from simulator.can.drive import DriveMount
from simulator.cell import SimulatedCell
from simulator.devices import CellDevices
from simulator.errors import EndpointError, PartGripped, SimulatorError, SimulatorSettingsError
from simulator.realtime.hands import HELP, Hands
from simulator.realtime.process import (
    FORGIVEN_S,
    PIECE_S,
    CellRequests,
    PositionerServer,
    RealTimeCell,
)
from simulator.realtime.terminals import SerialPty
from simulator.servo.bus import ServoBusDevice
from simulator.servo.protocol2 import Instruction
from simulator.servo.wrist import WristMount
from simulator.settings import SimulatorSettings
from tests.simulator.conftest import ServoBench, encode_instruction

SCRIPT = """
import json, pathlib, sys
from simulator.realtime.process import serve
from simulator.settings import SimulatorSettings

serve(
    SimulatorSettings(),
    lambda line: print(json.dumps(line), flush=True),
    folder=pathlib.Path(sys.argv[1]),
)
"""
LIMIT_S = 60.0


class Stepped:
    """A cell of real terminals in a time that the test makes."""

    def __init__(self, folder: Path, settings: SimulatorSettings | None = None) -> None:
        self.now_s = 100.0
        self.cell = RealTimeCell(settings or SimulatorSettings(), folder, self.now_s)
        self.hello = self.cell.announcement()

    def run(self, seconds: float) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            readable, _, _ = select.select(self.cell.descriptors(), [], [], 0)
            due_s = self.cell.step(self.now_s, readable)
            assert due_s > self.now_s
            self.now_s = min(due_s, self.now_s + 1e-3)


@pytest.fixture
def stepped(tmp_path: Path) -> Iterator[Stepped]:
    one = Stepped(tmp_path)
    with one.cell:
        yield one


def terminal(path: str) -> serial.Serial:
    """Open a terminal; the kernel passes bytes on by itself, a little later."""
    return serial.Serial(path, 1_000_000, timeout=0.02)


def test_axes_have_terminals_of_their_own_and_carry_the_object(tmp_path: Path) -> None:
    drive = DriveMount(node_id=11, increments=1e6, start=2e-3, low_switch=-0.02, high_switch=0.02)
    wrist = WristMount(servo_id=7, increments=4096 / math.tau, zero=500, start=0.5)
    one = Stepped(tmp_path, SimulatorSettings(axes={"x": drive, "roll": wrist}))
    with one.cell:
        assert one.hello["axes_can_channel"] == str(tmp_path / "axes-can")
        assert one.hello["axes_ports"] == {"roll": str(tmp_path / "axis-roll")}
        with terminal(one.hello["axes_can_channel"]) as line:
            line.write(b"S8\rO\r")
            one.run(0.005)
            # Upload of the device type, 1000h, and the profile number in its low word.
            line.write(b"t60B84000100000000000\r")
            one.run(0.01)
            assert b"t58B8430010009201" in line.read(99)
        with terminal(one.hello["axes_ports"]["roll"]) as port:
            port.write(encode_instruction(7, Instruction.PING))
            one.run(0.01)
            assert port.read(99).startswith(b"\xff\xff\xfd\x00\x07")
        assert one.cell.devices.place("box").x_m == pytest.approx(2e-3)
        one.cell.devices.axes["x"].slipped = 0.003
        one.run(0.05)
        label, pose = one.cell.devices.world.placed or ("", None)
        assert label == "box"
        assert pose.x_m == pytest.approx(5e-3)
    assert not (tmp_path / "axes-can").exists()
    assert not (tmp_path / "axis-roll").exists()


def test_pulling_and_plugging_the_cables_is_felt(stepped: Stepped) -> None:
    paths = {"can": stepped.hello["can_channel"], "servos": stepped.hello["servo_port"]}
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.connect(stepped.hello["positioner_socket"])
    client.settimeout(5.0)
    for name, path in paths.items():
        with terminal(path) as line:
            client.sendall(json.dumps({"inject": f"{name}.unplugged"}).encode() + b"\n")
            stepped.run(0.02)
            assert json.loads(client.recv(4096)) == {"inject": f"{name}.unplugged"}
            with pytest.raises(serial.SerialException, match="Input/output error"):
                line.write(b"V\r")
            assert not Path(path).exists()
        client.sendall(json.dumps({"clear": f"{name}.unplugged"}).encode() + b"\n")
        stepped.run(0.02)
        assert json.loads(client.recv(4096)) == {"cleared": 1}
        assert Path(path).is_symlink()
    client.close()
    with terminal(stepped.hello["can_channel"]) as line:
        line.write(b"V\r")
        stepped.run(0.005)
        assert line.read(99) == b"V1013\r"


def test_a_cell_with_a_fault_that_does_not_fit_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(SimulatorSettingsError, match="pads are 0 to 9"):
        RealTimeCell(SimulatorSettings(faults=("taxels.saturated=10",)), tmp_path, 0.0)
    assert list(tmp_path.iterdir()) == []


def test_a_stall_is_caught_up_in_pieces_or_left_out(stepped: Stepped) -> None:
    world, cell = stepped.cell.devices.world, stepped.cell
    step = Mock(side_effect=cell.devices.mechanics.step)
    world._fingers = Mock(finger_position_m=(0.015, 0.015), step=step)
    now_s, per_call = stepped.now_s + 0.1, []
    for _ in range(6):
        step.reset_mock()
        cell.step(now_s, [])
        per_call.append(step.call_count)
    assert max(per_call) <= round(PIECE_S / 1e-3) + 1
    assert sum(per_call) == pytest.approx(100, abs=1)
    step.reset_mock()
    for _ in range(20):
        cell.step(now_s + 10 * FORGIVEN_S, [])
    assert step.call_count <= round(PIECE_S / 1e-3) + 1


def test_folders_that_cannot_be_used_are_an_error(tmp_path: Path) -> None:
    for name in ("servos", "can", "positioner.sock"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text("of somebody else")
        with pytest.raises(EndpointError):
            RealTimeCell(SimulatorSettings(), folder, 0.0)
        assert [one.name for one in folder.iterdir()] == [name]


@pytest.mark.slow
def test_it_ends_when_it_is_told_to_and_leaves_nothing_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert Path(json.loads(process.stdout.readline())["positioner_socket"]).is_socket()
            process.send_signal(signal.SIGINT)
            assert process.wait(LIMIT_S) == 0
        finally:
            process.kill()
        assert list(tmp_path.iterdir()) == []


PING = encode_instruction(1, Instruction.PING)


@pytest.fixture
def device() -> ServoBusDevice:
    return ServoBench().device


@pytest.fixture
def endpoint(device, tmp_path: Path) -> Iterator[SerialPty]:
    pty = SerialPty(device, tmp_path / "servos")
    yield pty
    pty.close()


@pytest.fixture
def client(endpoint) -> Iterator[serial.Serial]:
    with terminal(str(endpoint.path)) as port:
        yield port


def test_a_packet_that_waited_feeds_the_watchdog(endpoint, device, client):
    servo = device.servos[0]
    servo.write(64, b"\x01", 1.0)
    servo.write(98, b"\x05", 1.0)
    endpoint.poll(1.0)
    client.write(PING)
    endpoint.poll(1.5)
    device.advance_to(1.55)
    assert not servo.watchdog_tripped
    device.advance_to(1.61)
    assert servo.watchdog_tripped


@pytest.mark.parametrize("baudrate", [9_600, 57_600, 1_234_567, 4_000_000])
def test_another_rate_is_met_with_silence(endpoint, client, baudrate: int):
    client.baudrate = baudrate
    assert endpoint.client_baudrate == baudrate
    client.write(PING)
    assert endpoint.poll(1.0) == math.inf


def test_a_client_that_never_reads_does_not_block(endpoint, client):
    everything = encode_instruction(1, Instruction.READ, bytes((0, 0, 0xB0, 2)))
    for i in range(200):
        client.write(everything)
        due_s = endpoint.poll(float(i))
    assert endpoint._unsent
    assert due_s == math.inf
    while client.read(1 << 16):
        endpoint.poll(300.0)
    assert not endpoint._unsent


def test_an_old_link_is_replaced_and_a_foreign_one_left(device, tmp_path):
    path = tmp_path / "servos"
    path.symlink_to("/nowhere")
    endpoint = SerialPty(device, path)
    assert os.readlink(path) != "/nowhere"
    path.unlink()
    path.symlink_to("/elsewhere")
    endpoint.close()
    assert os.readlink(path) == "/elsewhere"


# -- Requests to a running cell, on its socket and in words of the hands ---------------------------


@pytest.fixture
def cell() -> SimulatedCell:
    """A cell in virtual time, whose control unit has booted."""
    made = SimulatedCell()
    made.clock.sleep(0.1)
    return made


@pytest.fixture
def devices(cell: SimulatedCell) -> CellDevices:
    return cell.devices


@pytest.fixture
def requests(cell: SimulatedCell) -> CellRequests:
    return CellRequests(cell.devices, cell.injector)


def test_objects_are_placed_and_the_reply_says_where_they_rest(requests, devices) -> None:
    reply = requests({"place": "box", "pose": {"x_m": 0.001, "roll_rad": 1.5}})
    x_m, *others, roll_rad = reply["pose"].values()
    assert (x_m, others, roll_rad) == (0.001, [0.0] * 3, pytest.approx(np.pi / 2))
    state = requests({"state": True})
    assert (state["placed"], state["aperture_m"]) == ("box", pytest.approx(0.03))
    assert state["control_unit"] == "PRE-OPERATIONAL"
    assert json.loads(json.dumps(state)) == state
    assert requests({"place": "sphere:diameter=8mm"})["pose"]["x_m"] == 0.0
    assert requests({"remove": True}) == {"removed": True}
    assert devices.world.placed is None


def test_named_objects_lie_beside_their_pose(requests, devices) -> None:
    assert requests({"check": "nothing"}) == {"known": True}
    with pytest.raises(SimulatorSettingsError, match="no object 'mug'; there are "):
        requests({"check": "mug"})
    devices.world.objects["mug"] = devices.world.shape("sphere:diameter=8mm")
    assert requests({"place": "mug"})["pose"]["x_m"] == 0.0
    requests({"place": "mug", "offset": {"x_m": 0.001}})
    assert requests({"place": "mug", "pose": {"x_m": 0.002}})["pose"]["x_m"] == 0.003
    assert requests({"state": True})["offset"]["x_m"] == 0.001
    devices.world._force_n = (1.0, 1.0)
    for label in ("mug", "nothing"):
        with pytest.raises(PartGripped, match="release it first"):
            requests({"place": label})
    devices.world._force_n = (0.0, 0.0)
    requests({"place": "nothing"})
    assert requests({"state": True})["placed"] is None


@pytest.mark.parametrize(
    ("request_", "says"),
    [
        ({"dance": True}, "needs one of place"),
        ({"place": "teapot"}, "no object 'teapot'; there are"),
        ({"place": "mesh:file=/etc/passwd"}, "mesh files are named in the settings"),
        ({"place": "ball", "pose": [1]}, "a pose is an object of x_m"),
        ({"place": "ball", "pose": {"x_m": float("nan")}}, "x_m is nan"),
        ({"place": "ball", "pose": {"x_m": 1.0}}, "lies beside the pad"),
        ({"place": "ball", "pose": {"y_m": 1e308}}, "limit 100 m"),
        ({"place": "ball", "pose": {"y_m": 10**400}}, "must be a finite number"),
        ({"place": "ball", "offset": {"x_m": 9.0}}, "lies beside the pad"),
        ({"press": ["finger0.tip"]}, "there is no pad"),
        ({"press": "finger0.tip", "at": "left"}, "a pad has the places tip, left"),
        ({"hand": {"3": 0.01}}, "there is no servo 3"),
        ({"inject": "can.lost"}, "did you mean can.loss"),
        ({"clear": None}, "clear takes the text of a fault"),
        ({"clear": "can.loss"}, "injected faults: none"),
    ],
    ids=str,
)
def test_requests_that_make_no_sense_are_refused_and_change_nothing(
    requests, devices, request_, says
) -> None:
    before = repr((devices.faults, devices.offset, list(devices.world.objects)))
    with pytest.raises(SimulatorError, match=re.escape(says)):
        requests(request_)
    assert repr((devices.faults, devices.offset, list(devices.world.objects))) == before
    assert devices.world.placed is None


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


@pytest.mark.parametrize("line", [b'{"a": 1', b"\xff", 9_000 * b"[", b"[1]"])
def test_a_line_that_is_no_request_is_answered_with_the_reason(served, line: bytes) -> None:
    with served.connect() as client:
        client.sendall(line + b"\n")
        served.poll()
        says = json.loads(client.recv(4096))["error"]
    assert says == "a request is a JSON object" if line == b"[1]" else "not valid JSON" in says
    assert served.asked == []


def test_a_client_that_is_gone_is_forgotten(served) -> None:
    client = served.connect()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.sendall(b'{"a": 1}\n')
    client.close()
    served.poll()
    assert len(served.server.filenos()) == 1


def test_the_socket_belongs_to_its_owner_and_replaces_a_stale_one(tmp_path) -> None:
    path = tmp_path / "s"
    stale = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    stale.bind(str(path))
    stale.close()
    served = Served(path)
    assert path.stat().st_mode & 0o777 == 0o600
    served.server.close()


class At:
    """Hands at a cell in virtual time."""

    def __init__(self, cell: SimulatedCell, requests: CellRequests) -> None:
        self.cell, self._requests = cell, requests
        self.do = Hands(requests, cell.clock.sleep).do

    @property
    def state(self) -> dict[str, Any]:
        return self._requests({"state": True})

    @property
    def fingers_mm(self) -> list[float]:
        return [round(1e3 * half_m) for half_m in self.state["fingers_m"]]


@pytest.fixture
def at(cell: SimulatedCell, requests: CellRequests) -> At:
    return At(cell, requests)


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
    assert at.do("help").endswith("finger1.tip; objects oval, cylinder, box, ball, dumbbell")


@pytest.mark.parametrize(
    ("where", "row", "column"),
    [
        ("finger0.inner", 8, 2.0),
        ("finger0.inner tip left", 13.5, 3.5),
        ("finger1.inner near tip and right edge", 13.5, 3.5),
        ("finger0.tip left inside", 5, 1.5),
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
    for wrong in ("dance", "block", "block ten", "open 7", "block -3", "press finger0.inner up"):
        with pytest.raises(SimulatorError):
            at.do(wrong)
    with pytest.raises(SimulatorSettingsError, match="`help` lists all commands"):
        at.do("disconnect two")
