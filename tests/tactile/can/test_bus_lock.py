"""One program at a time on a CAN bus."""

import fcntl
import os
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator

import pytest

from tactile.can.bus import bus_lock, close_bus, open_bus
from tactile.errors import BusNotOpened

HOLD = """
import sys
from tactile.can.bus import bus_lock
with bus_lock(sys.argv[1], sys.argv[2]):
    print("locked", flush=True)
    sys.stdin.readline()
"""


@pytest.fixture
def port() -> Iterator[str]:
    """A pseudo-terminal that takes no exclusive mode: as for an administrator."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def held_elsewhere(interface: str, channel: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, interface, channel],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "locked\n"
    return process


@pytest.mark.parametrize("interface", ["slcan", "socketcan"])
def test_a_second_program_is_refused_until_the_first_has_ended(interface, port) -> None:
    channel = port if interface == "slcan" else "can77"
    with held_elsewhere(interface, channel) as other:
        with pytest.raises(BusNotOpened, match="used by another program of this kind"):
            open_bus(interface, channel)
        other.kill()
    with bus_lock(interface, channel):
        pass


def test_a_link_to_the_port_is_the_same_port_and_closing_gives_it_back(port, tmp_path) -> None:
    link = tmp_path / "adapter"
    link.symlink_to(port)
    bus = open_bus("slcan", port)
    with pytest.raises(BusNotOpened, match="used by another program"):
        open_bus("slcan", str(link))
    close_bus(bus)
    close_bus(open_bus("slcan", str(link)))


def test_a_bus_that_cannot_be_opened_leaves_no_lock() -> None:
    for _ in range(2):
        with pytest.raises(BusNotOpened, match="ip link"):
            open_bus("socketcan", "can78")


def test_a_lock_file_of_another_user_is_used(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(tmp_path))
    with bus_lock("socketcan", "can79"):
        (file,) = tmp_path.iterdir()
    file.chmod(0o444)
    with bus_lock("socketcan", "can79"), file.open() as other, pytest.raises(BlockingIOError):
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)


def test_buses_within_a_program_are_shared() -> None:
    with bus_lock("virtual", "a"), bus_lock("virtual", "a"):
        pass


def test_a_bit_rate_that_an_adapter_lacks_leaves_its_port_free(port) -> None:
    with pytest.raises(BusNotOpened, match="bitrate") as refused:
        open_bus("slcan", port, bitrate=800_000)
    handle = os.open(port, os.O_RDWR | os.O_NOCTTY)
    try:
        # As the driver locks it; the error above keeps all that it has seen alive.
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.close(handle)
    assert refused.value.__cause__ is not None
    with bus_lock("slcan", port):
        pass
