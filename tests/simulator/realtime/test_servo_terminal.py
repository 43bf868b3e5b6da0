"""The servo terminal: rates, link, unplugging; driven step by step with a made-up time."""

import errno
import fcntl
import os
import struct
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest

from simulator.realtime.terminals import ServoPty
from simulator.servo.bus import ServoBusDevice
from simulator.servo.protocol2 import Instruction, encode_instruction

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
