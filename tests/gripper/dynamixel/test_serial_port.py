"""The serial port of the operating system, on a pseudo-terminal; no test waits for a time."""

import os
import pty
import threading
import tty
from collections.abc import Iterator
from contextlib import suppress

import pytest

from gripper.dynamixel.serial_port import SdkPort, SerialStream, latency_timer_ms, serial_candidates
from gripper.errors import PortLost
from tests.values import raising


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    master, slave = pty.openpty()
    tty.setraw(master)
    yield master, os.ttyname(slave)
    os.close(slave)
    with suppress(OSError):
        os.close(master)


def test_bytes_go_both_ways_and_a_read_returns_at_once(terminal) -> None:
    master, path = terminal
    stream = SerialStream(path)
    stream.write(b"\x01\x02\xff")
    assert os.read(master, 10) == b"\x01\x02\xff"
    os.write(master, b"\xfd\x00\x11")
    assert stream.read(2, 5.0) == b"\xfd\x00"
    assert stream.read(2, 5.0) == b"\x11"
    assert stream.read(2, 0.0) == b""
    os.write(master, b"old")
    assert stream.read(1, 5.0) == b"o"
    stream.drop_input()
    assert stream.read(9, 0.0) == b""
    assert latency_timer_ms(stream.path) is None
    stream.close()
    stream.close()


def test_a_missing_port_names_itself_and_what_to_check() -> None:
    with pytest.raises(PortLost, match=r"/dev/ttyNoSuch.*check the path.*Serial ports found"):
        SerialStream("/dev/ttyNoSuch")
    assert isinstance(serial_candidates(), tuple)


def test_a_second_program_is_kept_out(terminal) -> None:
    _, path = terminal
    first = SerialStream(path)
    with pytest.raises(PortLost, match="another program"):
        SerialStream(path)
    first.close()
    SerialStream(path).close()


def test_boards_have_baud_rates_that_no_servo_has(terminal) -> None:
    SerialStream(terminal[1], 921_600).close()
    with pytest.raises(PortLost, match="-1"):
        SerialStream(terminal[1], -1)


def test_no_right_to_open_says_so(tmp_path, monkeypatch) -> None:
    refuse = raising(PermissionError(13, "Permission denied"))
    path = tmp_path / "tty"
    path.touch()
    monkeypatch.setattr("gripper.dynamixel.serial_port.serial.Serial", refuse)
    with pytest.raises(PortLost, match="no right to open"):
        SerialStream(str(path))


def test_an_unplugged_adapter_is_a_lost_port(terminal) -> None:
    master, path = terminal
    stream = SerialStream(path)
    os.close(master)
    with pytest.raises(PortLost, match="is lost"):
        stream.read(1, 5.0)
    with pytest.raises(PortLost, match="may still be gripped"):
        stream.write(b"x")
    with pytest.raises(PortLost):
        stream.drop_input()
    stream.close()


def test_a_long_write_goes_through_and_an_adapter_that_takes_nothing_is_lost(terminal) -> None:
    master, path = terminal
    stream = SerialStream(path)
    data, arrived = bytes(range(256)) * 1200, bytearray()

    def fetch() -> None:
        while len(arrived) < len(data):
            arrived.extend(os.read(master, 65536))

    reader = threading.Thread(target=fetch)
    reader.start()
    stream.write(data)
    reader.join(20.0)
    assert arrived == data
    with pytest.raises(PortLost, match="it takes no data"):
        stream.write(data)
    stream.close()


def test_the_port_times_out_after_wire_delay_and_allowance(script, clock) -> None:
    port = SdkPort(script, clock, baudrate=1_000_000, return_delay_s=0.0005, allowance_s=0.001)
    script.expect("00" * 20)
    port.writePort(bytes(20))
    port.setPacketTimeout(30)
    assert port.readPort(4) == b""
    assert port.isPacketTimeout()
    assert clock.monotonic() == pytest.approx(0.0005 + 0.0005 + 0.001)


def test_bytes_without_a_pause_are_read_for_one_longest_packet_more(script, clock) -> None:
    port = SdkPort(script, clock, baudrate=1_000_000, return_delay_s=0.0, allowance_s=0.001)
    script.chatter = b"\xa5"
    port.start_timeout(0.002)
    clock.sleep(0.05)
    while port.readPort(4):
        pass
    assert 0.010 < clock.monotonic() - 0.05 < 0.011
    assert port.isPacketTimeout()
