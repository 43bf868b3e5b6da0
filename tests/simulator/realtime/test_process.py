"""A cell on real terminals, driven step by step with a made-up time."""

import contextlib
import errno
import fcntl
import json
import math
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

from simulator.can.drive import DriveMount
from simulator.errors import EndpointError, SimulatorSettingsError
from simulator.realtime.process import FORGIVEN_S, PIECE_S, RealTimeCell, serve
from simulator.realtime.terminals import ServoPty
from simulator.servo.bus import ServoBusDevice
from simulator.servo.protocol2 import Instruction, encode_instruction
from simulator.servo.wrist import WristMount
from simulator.settings import SimulatorSettings

SCRIPT = """
import json
from simulator.realtime.process import serve
from simulator.settings import SimulatorSettings

serve(
    SimulatorSettings(),
    lambda line: print(json.dumps(line), flush=True),
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


@contextlib.contextmanager
def terminal(path: str) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def received(descriptor: int) -> bytes:
    """Return what has arrived; the kernel passes bytes on by itself, a little later."""
    data = b""
    while select.select([descriptor], [], [], 0.02)[0]:
        data += os.read(descriptor, 1 << 16)
    return data


def test_the_announcement_is_plain_and_complete(stepped: Stepped, tmp_path: Path) -> None:
    hello = stepped.hello
    assert json.loads(json.dumps(hello)) == hello
    assert hello == {
        "servo_port": str(tmp_path / "servos"),
        "servo_baud_rate": 1_000_000,
        "servo_ids": [1, 2],
        "can_interface": "slcan",
        "can_channel": str(tmp_path / "can"),
        "can_bitrate": 1_000_000,
        "node_id": 5,
        "axes_can_channel": None,
        "axes_ports": {},
        "board_ports": [],
        "positioner_socket": str(tmp_path / "positioner.sock"),
        "pid": os.getpid(),
        "config": None,
    }


def test_axes_have_terminals_of_their_own_and_carry_the_object(tmp_path: Path) -> None:
    drive = DriveMount(node_id=11, increments=1e6, start=2e-3, low_switch=-0.02, high_switch=0.02)
    wrist = WristMount(servo_id=7, increments=4096 / math.tau, zero=500, start=0.5)
    one = Stepped(tmp_path, SimulatorSettings(axes={"x": drive, "roll": wrist}))
    with one.cell:
        assert one.hello["axes_can_channel"] == str(tmp_path / "axes-can")
        assert one.hello["axes_ports"] == {"roll": str(tmp_path / "axis-roll")}
        with terminal(one.hello["axes_can_channel"]) as line:
            os.write(line, b"S8\rO\r")
            one.run(0.005)
            # Upload of the device type, 1000h, and the profile number in its low word.
            os.write(line, b"t60B84000100000000000\r")
            one.run(0.01)
            assert b"t58B8430010009201" in received(line)
        with serial.Serial(one.hello["axes_ports"]["roll"], 1_000_000, timeout=0.0) as port:
            port.write(encode_instruction(7, Instruction.PING))
            one.run(0.01)
            assert received(port.fileno()).startswith(b"\xff\xff\xfd\x00\x07")
        placed = one.cell.devices.place("box")
        assert placed.x_m == pytest.approx(2e-3)
        one.cell.devices.axes["x"].slipped = 0.003
        one.run(0.05)
        label, pose = one.cell.devices.physical.placed or ("", None)
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
            with pytest.raises(OSError, match="error") as caught:
                os.write(line, b"V\r")
            assert caught.value.errno == errno.EIO
            assert not Path(path).exists()
        client.sendall(json.dumps({"clear": f"{name}.unplugged"}).encode() + b"\n")
        stepped.run(0.02)
        assert json.loads(client.recv(4096)) == {"cleared": 1}
        assert Path(path).is_symlink()
    client.close()
    with terminal(stepped.hello["can_channel"]) as line:
        os.write(line, b"V\r")
        stepped.run(0.005)
        assert received(line) == b"V1013\r"


def test_faults_of_the_settings_come_and_go_at_their_times(tmp_path: Path) -> None:
    faults = ("can.unplugged@100ms..200ms", "servos.unplugged@150ms..250ms", "unit.off@1s")
    stepped = Stepped(tmp_path, SimulatorSettings(faults=faults))
    with stepped.cell:
        stepped.run(0.025)
        seen = []
        for _ in range(6):
            seen.append((stepped.cell._can_pty.plugged_in, stepped.cell._servo_pty.plugged_in))
            stepped.run(0.05)
        there, can_out = (True, True), (False, True)
        assert seen == [there, there, can_out, (False, False), (True, False), there]
        assert not stepped.cell.devices.faults.unit.dead
        stepped.run(0.75)
        assert stepped.cell.devices.faults.unit.dead


def test_a_cell_with_a_fault_that_does_not_fit_leaves_nothing_behind(tmp_path: Path) -> None:
    with pytest.raises(SimulatorSettingsError, match="pads are 0 to 9"):
        RealTimeCell(SimulatorSettings(faults=("taxels.saturated=10",)), tmp_path, 0.0)
    assert list(tmp_path.iterdir()) == []


def test_a_stall_is_caught_up_in_pieces_or_left_out(stepped: Stepped) -> None:
    world, cell = stepped.cell.devices.world, stepped.cell
    steps: list[float] = []
    original = stepped.cell.devices.mechanics.step

    class Counting:
        finger_position_m = (0.015, 0.015)

        def step(self, dt_s: float, *rest: Any) -> None:
            steps.append(dt_s)
            original(dt_s, *rest)

    world._fingers = Counting()
    now_s = stepped.now_s + 0.1
    per_call = []
    for _ in range(6):
        steps.clear()
        cell.step(now_s, [])
        per_call.append(len(steps))
    assert max(per_call) <= round(PIECE_S / 1e-3) + 1
    assert sum(per_call) == pytest.approx(100, abs=1)
    steps.clear()
    for _ in range(20):
        cell.step(now_s + 10 * FORGIVEN_S, [])
    assert len(steps) <= round(PIECE_S / 1e-3) + 1


def test_folders_that_cannot_be_used_are_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(EndpointError, match="cannot be made"):
        serve(SimulatorSettings(), lambda _line: None, folder=tmp_path / "file" / "below")
    for name in ("servos", "can", "positioner.sock"):
        folder = tmp_path / name
        folder.mkdir()
        (folder / name).write_text("of somebody else")
        with pytest.raises(EndpointError):
            RealTimeCell(SimulatorSettings(), folder, 0.0)
        assert [one.name for one in folder.iterdir()] == [name]


@pytest.mark.slow
def test_it_ends_when_it_is_told_to_and_leaves_nothing_behind() -> None:
    command = [sys.executable, "-c", SCRIPT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            folder = Path(json.loads(process.stdout.readline())["positioner_socket"]).parent
            assert folder.is_dir()
            process.send_signal(signal.SIGINT)
            assert process.wait(LIMIT_S) == 0
        finally:
            process.kill()
        assert not folder.exists()


PING = encode_instruction(1, Instruction.PING)


@pytest.fixture
def device(servo_bench) -> ServoBusDevice:
    return servo_bench().device


@pytest.fixture
def endpoint(device, tmp_path: Path) -> Iterator[ServoPty]:
    pty = ServoPty(device, tmp_path / "servos")
    yield pty
    pty.close()


@pytest.fixture
def client(endpoint) -> Iterator[int]:
    descriptor = open_client(endpoint)
    yield descriptor
    os.close(descriptor)


def open_client(endpoint: ServoPty, speed: int = termios.B1000000) -> int:
    descriptor = os.open(endpoint.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(descriptor)
    settings = termios.tcgetattr(descriptor)
    settings[4] = settings[5] = speed
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    return descriptor


def drain(descriptor: int) -> bytes:
    try:
        return os.read(descriptor, 4096)
    except BlockingIOError:
        return b""


def test_a_packet_that_waited_feeds_the_watchdog(endpoint, device, client):
    servo = device.servos[0]
    servo.write(64, b"\x01", 1.0)
    servo.write(98, b"\x05", 1.0)
    endpoint.poll(1.0)
    os.write(client, PING)
    endpoint.poll(1.5)
    device.advance_to(1.55)
    assert not servo.core.watchdog_tripped
    device.advance_to(1.61)
    assert servo.core.watchdog_tripped


@pytest.mark.parametrize("speed", [termios.B9600, termios.B57600, termios.B4000000])
def test_another_rate_is_met_with_silence(endpoint, speed: int):
    descriptor = open_client(endpoint, speed)
    os.write(descriptor, PING)
    assert endpoint.poll(1.0) is None
    os.close(descriptor)


@pytest.mark.parametrize("baudrate", [1_000_000, 1_234_567])
def test_a_rate_set_as_a_number_is_known_too(endpoint, client, baudrate: int):
    layout = struct.Struct("=4IB19s2I")
    settings = list(layout.unpack(fcntl.ioctl(client, 0x802C542A, bytes(layout.size))))
    settings[2] = settings[2] & ~0o10017 | 0o10000
    settings[-2:] = [baudrate, baudrate]
    fcntl.ioctl(client, 0x402C542B, layout.pack(*settings))
    assert endpoint.client_baudrate == baudrate


def test_a_client_that_never_reads_does_not_block(endpoint, client):
    everything = encode_instruction(1, Instruction.READ, bytes((0, 0, 0xB0, 2)))
    due_s: float | None = 0.0
    for i in range(200):
        os.write(client, everything)
        due_s = endpoint.poll(float(i))
    assert due_s == 199.0
    while drain(client):
        due_s = endpoint.poll(300.0)
    assert due_s is None


def test_closing_gives_everything_back(device, tmp_path):
    endpoint = ServoPty(device, tmp_path / "servos")
    descriptor = endpoint.fileno()
    endpoint.close()
    endpoint.close()
    assert not os.path.lexists(tmp_path / "servos")
    with pytest.raises(OSError, match=os.strerror(errno.EBADF)):
        os.fstat(descriptor)


def test_without_a_link_the_port_is_the_terminal(device):
    endpoint = ServoPty(device)
    assert endpoint.path.startswith("/dev/")
    endpoint.close()


def test_an_old_link_is_replaced_and_a_foreign_one_left(device, tmp_path):
    path = tmp_path / "servos"
    path.symlink_to("/nowhere")
    endpoint = ServoPty(device, path)
    assert os.readlink(path) != "/nowhere"
    path.unlink()
    path.symlink_to("/elsewhere")
    endpoint.close()
    assert os.readlink(path) == "/elsewhere"
