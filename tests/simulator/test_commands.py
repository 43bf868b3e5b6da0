import json
import socket
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simulator.assembly import CellDevices, SimulatedCell
from simulator.commands import CellCommands
from simulator.errors import EndpointError, SimulatorError, SimulatorSettingsError
from simulator.positioner_server import CLIENT_LIMIT, LINE_LIMIT, PositionerServer
from simulator.settings import RecordedGrasp, SimulatorSettings
from tactile.layouts import pinch_layout


@pytest.fixture
def devices() -> CellDevices:
    cell = CellDevices(SimulatorSettings())
    cell.unit.connect(lambda ready_s, _can_id, _messages: ready_s)
    cell.unit.advance(0.1)
    return cell


@pytest.fixture
def pulled() -> list[str]:
    return []


@pytest.fixture
def commands(devices: CellDevices, pulled: list[str]) -> CellCommands:
    plugs = {"can": (lambda: pulled.append("out"), lambda: pulled.append("in"))}
    return CellCommands(devices, plugs, lambda: 0.1)


def test_objects_are_placed_and_the_reply_says_where_they_rest(
    commands: CellCommands, devices: CellDevices
) -> None:
    reply = commands({"place": "box", "pose": {"x_m": 0.001, "roll_rad": 1.5}})
    assert reply["pose"] == {
        "x_m": 0.001,
        "y_m": 0.0,
        "z_m": 0.0,
        "rotation_rad": 0.0,
        "roll_rad": pytest.approx(np.pi / 2),
    }
    state = commands({"state": True})
    assert state["placed"] == "box"
    assert state["aperture_m"] == pytest.approx(0.03)
    assert state["control_unit"] == "PRE-OPERATIONAL"
    assert json.loads(json.dumps(state)) == state
    assert commands({"place": "sphere:diameter=8mm"})["pose"]["x_m"] == 0.0
    assert commands({"remove": True}) == {"removed": True}
    assert devices.physical.placed is None


def test_faults_are_turned_by_their_names(commands: CellCommands, devices: CellDevices) -> None:
    for path, value in [
        ("can.drop_rate", 0.25),
        ("can.drop_next", 3),
        ("unit.heartbeat_off", True),
        ("unit.offset_counts", -4),
        ("servo_wire.drop.probability", 0.5),
        ("servo_wire.echo", True),
    ]:
        assert commands({"fault": path, "value": value}) == {"fault": path, "value": value}
        owner: Any = devices.faults
        for name in path.split("."):
            owner = getattr(owner, name)
        assert owner == value
    commands({"fault": "unit.stuck_counts", "value": {"3": 200}})
    commands({"fault": "unit.dead_taxels", "value": [1, 2]})
    assert devices.faults.unit.stuck_counts == {3: 200}
    assert devices.faults.unit.dead_taxels == {1, 2}


def test_single_servos_can_be_made_to_fail(commands: CellCommands, devices: CellDevices) -> None:
    motor = devices.mechanics.motors[1]
    commands({"servo": 2, "do": "overheat", "value": 79.0})
    assert motor.temperature_c == 79.0
    commands({"servo": 2, "do": "supply", "value": 9.5})
    assert motor.voltage_v == 9.5
    commands({"servo": 2, "do": "overload"})
    assert motor.load_excess_s > 0.0
    commands({"servo": 2, "do": "stick_encoder"})
    assert motor.stuck_at_rad is not None
    commands({"servo": 2, "do": "hardware_error", "value": 16})
    commands({"servo": 2, "do": "clear"})
    assert motor.stuck_at_rad is None
    commands({"servo": 2, "do": "reboot"})
    assert devices.servo_bus.servos[1].core.silent_until_s > 0.1
    assert devices.servo_bus.servos[0].core.silent_until_s <= 0.1


def test_the_control_unit_can_be_made_to_fail(commands: CellCommands, devices: CellDevices) -> None:
    assert commands({"emergency": 0x5000}) == {"emergency": 0x5000}
    assert commands({"power_cycle": True}) == {"power_cycle": True}
    assert devices.unit.next_event_s() == pytest.approx(0.12)


def test_cables_can_be_pulled(commands: CellCommands, pulled: list[str]) -> None:
    commands({"unplug": "can"})
    commands({"plug_in": "can"})
    assert pulled == ["out", "in"]


def test_recorded_grasps_are_played_by_number() -> None:
    grasp = RecordedGrasp(counts=np.zeros((4, 156), np.uint16), aperture_m=np.full(4, 0.02))
    devices = CellDevices(SimulatorSettings(layout=pinch_layout(), grasps=(grasp,)))
    commands = CellCommands(devices, {}, lambda: 0.0)
    assert commands({"play": 0}) == {"frames": 4}
    assert commands({"state": True})["frames_left"] == 4
    for request in ({"play": 1}, {"play": "0"}, {"place": "ball"}, {"unplug": "can"}):
        with pytest.raises(SimulatorError):
            commands(request)


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
        {"remove": False},
        {"state": 1},
        {"play": 0},
        {"fault": "can.drop_rate"},
        {"fault": 3, "value": 1},
        {"fault": "can.nothing", "value": 1},
        {"fault": "can.__class__", "value": 1},
        {"fault": "servos.1", "value": 1},
        {"fault": "can", "value": 1},
        {"fault": "can.drop_rate", "value": 1.5},
        {"fault": "can.drop_rate", "value": True},
        {"fault": "can.drop_rate", "value": float("inf")},
        {"fault": "can.drop_next", "value": 0.5},
        {"fault": "can.drop_next", "value": -1},
        {"fault": "can.delay_s", "value": 1e4},
        {"fault": "can.bus_off", "value": 1},
        {"fault": "can.unplugged", "value": True},
        {"fault": "unit.dead_taxels", "value": [408]},
        {"fault": "unit.dead_taxels", "value": 5},
        {"fault": "unit.stuck_counts", "value": {"0": 256}},
        {"fault": "unit.stuck_counts", "value": {"a": 1}},
        {"fault": "servo_wire.drop.probability", "value": 2},
        {"fault": "servo_wire.garbage_data", "value": "AA"},
        {"servo": 9, "do": "overload"},
        {"servo": [1], "do": "overload"},
        {"servo": 1, "do": ["overload"]},
        {"servo": 1},
        {"servo": 1, "do": "overheat"},
        {"servo": 1, "do": "hardware_error", "value": 1.5},
        {"emergency": 1 << 16},
        {"emergency": True},
        {"power_cycle": "yes"},
        {"unplug": "servos"},
        {"plug_in": ["can"]},
    ],
    ids=str,
)
def test_requests_that_make_no_sense_are_refused_and_change_nothing(
    commands: CellCommands, devices: CellDevices, request_: dict[str, Any]
) -> None:
    before = repr((devices.faults.can, devices.faults.unit, devices.faults.servo_wire))
    with pytest.raises(SimulatorError):
        commands(request_)
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


def test_each_request_is_answered_on_its_own_line(tmp_path: Path) -> None:
    served = Served(tmp_path / "s")
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
    served.server.close()
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize("line", [b"no json", b"[1]", b"\xff\xfe", b"[" * 50_000, b"1" * 5000])
def test_lines_that_are_no_request_get_an_error(tmp_path: Path, line: bytes) -> None:
    served = Served(tmp_path / "s")
    with served.connect() as client:
        client.sendall(line + b"\n")
        served.poll()
        assert "error" in json.loads(client.recv(4096))
        client.sendall(b'{"a": 1}\n')
        served.poll()
        assert json.loads(client.recv(4096)) == {"n": 1}
    served.server.close()


def test_a_request_without_an_end_is_cut_off(tmp_path: Path) -> None:
    served = Served(tmp_path / "s")
    with served.connect() as client:
        client.setblocking(False)
        sent = 0
        while sent <= LINE_LIMIT:
            sent += client.send(b"x" * 10_000)
            served.poll()
        client.settimeout(5.0)
        assert b"at most" in client.recv(4096)
        assert client.recv(4096) == b""
    served.server.close()


def test_a_client_that_is_gone_is_forgotten(tmp_path: Path) -> None:
    served = Served(tmp_path / "s")
    client = served.connect()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    client.sendall(b'{"a": 1}\n')
    client.close()
    served.poll()
    assert len(served.server.filenos()) == 1
    served.server.close()


def test_only_so_many_clients_are_served(tmp_path: Path) -> None:
    served = Served(tmp_path / "s")
    clients = [served.connect() for _ in range(CLIENT_LIMIT + 1)]
    served.poll()
    assert len(served.server.filenos()) == CLIENT_LIMIT + 1
    assert clients[-1].recv(1) == b""
    served.server.close()
    for client in clients:
        client.close()


def test_the_socket_belongs_to_its_owner_and_replaces_a_stale_one(tmp_path: Path) -> None:
    path = tmp_path / "s"
    stale = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    stale.bind(str(path))
    stale.close()
    served = Served(path)
    assert path.stat().st_mode & 0o777 == 0o600
    served.server.close()


def test_a_socket_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "s").write_text("a file of somebody else")
    with pytest.raises(EndpointError, match="no socket"):
        Served(tmp_path / "s")
    assert (tmp_path / "s").read_text() == "a file of somebody else"


def test_faults_are_injected_and_cleared_by_their_text(
    commands: CellCommands, devices: CellDevices
) -> None:
    assert commands({"inject": "can.loss=0.5@50ms"}) == {"inject": "can.loss=0.5@50ms"}
    assert commands({"state": True})["faults"] == {"can.loss=0.5@50ms": None}
    devices.advance_to(0.2)
    assert devices.faults.can.drop_rate == 0.5
    began_s = commands({"state": True})["faults"]["can.loss=0.5@50ms"]
    assert began_s == pytest.approx(0.2)
    assert commands({"clear": "can.loss"}) == {"cleared": 1}
    assert devices.faults.can.drop_rate == 0.0
    for request in ({"inject": "can.lost"}, {"clear": "can.loss"}, {"inject": 5}, {"clear": None}):
        with pytest.raises(SimulatorError):
            commands(request)


def test_the_settings_bring_their_faults_along() -> None:
    with SimulatedCell(SimulatorSettings(faults=("can.loss=0.5@50ms", "unit.off"))) as cell:
        assert cell.faults.unit.dead
        assert [fault.began_s for fault in cell.devices.injector.faults] == [0.0, None]
    with pytest.raises(SimulatorSettingsError, match=r"no fault 'can.lost'"):
        SimulatorSettings(faults=("can.lost",))
