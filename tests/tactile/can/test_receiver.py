"""Buses and receivers: slcan over a pseudo-terminal, the receive thread, one program on a bus."""

import fcntl
import gc
import os
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from unittest.mock import Mock

import can
import pytest
from can.interfaces.virtual import VirtualBus

from tactile.can.bus import (
    BulkSlcanBus,
    MissingBus,
    PolledSource,
    ThreadedReceiver,
    bus_lock,
    close_bus,
    open_bus,
)
from tactile.errors import BusNotOpened, BusOff, ReceiveLoopDead
from tests.fuzz.harness import Clock


class QueueBus(VirtualBus):
    """A bus whose queue may have errors that it raises, too, and functions that it calls."""

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        item, filtered = super()._recv_internal(timeout)
        if isinstance(item, Exception):
            raise item
        if callable(item):
            item()
            return None, filtered
        return item, filtered

    def settle(self) -> None:
        """Wait until the receiver has worked off the queue."""
        done = threading.Event()
        self.queue.put(done.set)
        assert done.wait(5.0)


@pytest.fixture
def bus() -> Iterator[QueueBus]:
    queue_bus = QueueBus()
    yield queue_bus
    queue_bus.shutdown()


def message(number: int, *, is_rx: bool = True) -> can.Message:
    return can.Message(arbitration_id=number, is_extended_id=False, is_rx=is_rx)


def test_thread_stamps_and_queues_in_order_without_echoes(bus) -> None:
    bus.queue.put(message(99))
    receiver = ThreadedReceiver(bus, time)
    receiver.start()
    before_s = time.monotonic()
    bus.queue.put(message(99, is_rx=False))
    for number in range(50):
        bus.queue.put(message(number))
    bus.settle()
    received = receiver.drain()
    receiver.close()
    assert [m.arbitration_id for _, m in received] == list(range(50))
    stamps = [t_s for t_s, _ in received]
    assert stamps == sorted(stamps)
    assert before_s <= stamps[0] <= time.monotonic()
    with pytest.raises(ReceiveLoopDead, match="not running"):
        receiver.drain()


def ended(receiver: ThreadedReceiver, end: Callable[[], object]) -> None:
    """Start the receiver, do what ends its thread, and wait for that."""
    receiver.start()
    thread = next(t for t in threading.enumerate() if t.name == "tactile-receive")
    end()
    thread.join(5.0)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        (can.CanOperationError("unplugged"), BusOff),
        (OSError(19, "no such device"), BusOff),
        (RuntimeError("driver bug"), ReceiveLoopDead),
    ],
)
def test_an_error_in_the_thread_is_a_fault_every_time(bus, error, fault) -> None:
    receiver = ThreadedReceiver(bus, time)
    ended(receiver, lambda: bus.queue.put(error))
    for _ in range(2):
        with pytest.raises(fault, match=r"start the link again|the next start opens it anew"):
            receiver.drain()
    receiver.close()
    receiver.start()
    assert receiver.drain() == []
    receiver.close()


def test_a_queue_that_nobody_empties_is_a_fault(bus) -> None:
    receiver = ThreadedReceiver(bus, time, limit=5)
    ended(receiver, lambda: [bus.queue.put(message(number)) for number in range(6)])
    with pytest.raises(ReceiveLoopDead, match="5 CAN messages wait"):
        receiver.drain()
    receiver.close()


def test_a_driver_that_hangs_is_a_fault(bus) -> None:
    clock = Clock()
    receiver = ThreadedReceiver(bus, clock)
    hang, hanging = threading.Event(), threading.Event()
    receiver.start()

    def hold() -> None:
        hanging.set()
        hang.wait(10.0)

    bus.queue.put(hold)
    assert hanging.wait(5.0)
    clock.now_s = 1.5
    with pytest.raises(ReceiveLoopDead, match=r"did not come round for 1\.5"):
        receiver.drain()
    hang.set()
    receiver.close()


def test_polled_source_bounds_what_it_takes_at_once(bus) -> None:
    source = PolledSource(bus, time, limit=3)
    for number in range(10):
        bus.queue.put(message(number))
    source.start()
    assert source.drain() == []
    for number in range(5):
        bus.queue.put(message(number, is_rx=number != 2))  # an adapter returns what was sent
    assert [m.arbitration_id for _, m in source.drain()] == [0, 1]
    assert [m.arbitration_id for _, m in source.drain()] == [3, 4]
    bus.queue.put(can.CanOperationError(""))
    with pytest.raises(BusOff, match="CanOperationError"):
        source.drain()
    source.close()


# --- slcan ---------------------------------------------------------------------------------------


class Adapter:
    """The other end of a pseudo-terminal, without an exclusive mode: as for an administrator."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        self.slave = slave

    def write(self, data: bytes) -> None:
        os.write(self.master, data)

    def read(self, end: bytes) -> bytes:
        """Return what comes up to an end, but for questions after the flags."""
        data = b""
        while not data.endswith(end):
            data += os.read(self.master, 4096).replace(b"F\r", b"")
        return data

    def unplug(self) -> None:
        os.close(self.master)
        self.master = -1

    def close(self) -> None:
        for descriptor in (self.master, self.slave):
            if descriptor >= 0:
                os.close(descriptor)


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    one = Adapter()
    yield one
    one.close()


@pytest.fixture
def slcan(adapter: Adapter) -> Iterator[BulkSlcanBus]:
    bus = open_bus("slcan", adapter.path, bitrate=1_000_000, nodes=(1,))
    assert isinstance(bus, BulkSlcanBus)
    yield bus
    close_bus(bus)


def received(bus: can.BusABC) -> list[can.Message]:
    messages = []
    while (message := bus.recv(0.2 if not messages else 0)) is not None:
        messages.append(message)
    return messages


def test_slcan_opens_with_bit_rate_and_without_waiting(adapter, monkeypatch) -> None:
    waits_s: list[float] = []
    with monkeypatch.context() as patched:
        patched.setattr(time, "sleep", waits_s.append)
        bus = open_bus("slcan", adapter.path, bitrate=500_000)
    assert sum(waits_s) < 0.1
    assert b"S6\r" in adapter.read(b"O\rO\r")
    bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
    bus.send(can.Message(arbitration_id=0x605, data=b"\x40\x18", is_extended_id=False))
    assert adapter.read(b"18\r") == b"t0800\rt60524018\r"
    close_bus(bus)
    assert adapter.read(b"C\r") == b"C\r"


def test_an_adapter_takes_what_fits_although_the_process_stands_still(slcan, monkeypatch) -> None:
    monkeypatch.setattr("serial.serialutil.Timeout.TIME", iter(range(10_000)).__next__)
    numbers = iter(range(10_000))
    with pytest.raises(can.CanOperationError, match="cannot be written"):
        any(slcan.send(message(number)) for number in numbers)
    assert next(numbers) > 100


def test_an_unplugged_adapter_is_bus_off_and_can_be_closed(adapter, slcan) -> None:
    adapter.unplug()
    with pytest.raises(BusOff, match="plugged in"):
        PolledSource(slcan, time).drain()
    close_bus(slcan)


def test_an_adapter_that_is_error_passive_gives_an_error_frame_once(adapter, slcan) -> None:
    adapter.write(b"F00\rF20\rt1811AA\rF20\rF04\r")
    messages = received(slcan)
    assert sorted(m.is_error_frame for m in messages) == [False, True, True]
    changes = [(m.arbitration_id, m.data[1]) for m in messages if m.is_error_frame]
    assert changes == [(0x04, 0x30), (0x04, 0x40)]


def test_an_adapter_that_does_not_know_its_flags_is_left_in_peace(adapter) -> None:
    bus = open_bus("slcan", adapter.path)
    for _ in range(14):
        bus.recv(0.051)
    assert os.read(adapter.master, 4096).count(b"F\r") == 10
    close_bus(bus)


NOT_THERE = (
    ("slcan", "/dev/does-not-exist", "does-not-exist.*Check that the adapter is plugged in"),
    ("slcan", "", "serial port"),
    ("socketcan", "nocan7", "nocan7.*ip link"),
    ("no-such-interface", "x", "Check the names"),
    ("kvaser", "0", "library of its driver is missing.*package linuxcan of Kvaser"),
    ("gs_usb", "0", r"python-can\[gs-usb\]"),
    ("pcan", "PCAN_USBBUS1", "libpcanbasic"),
)
"""Interface, channel, and what the error says."""


def test_a_bus_that_cannot_be_opened_says_what_to_check_and_its_driver_nothing(caplog) -> None:
    for interface, channel, says in 2 * NOT_THERE:  # the first one leaves no lock
        with pytest.raises(BusNotOpened, match=says):
            open_bus(interface, channel)
    gc.collect()
    assert caplog.text == ""


def test_an_adapter_that_numbers_itself_is_opened_by_its_number(monkeypatch) -> None:
    opened = Mock(return_value=Mock())
    monkeypatch.setattr(can, "Bus", opened)
    for channel in ("0", "PCAN_USBBUS1"):
        close_bus(open_bus("gs_usb", channel))
    assert [call.args for call in opened.call_args_list] == [(0,), ("PCAN_USBBUS1",)]


def test_other_interfaces_are_opened_by_python_can_and_shared_within_a_program() -> None:
    first, second = (open_bus("virtual", "tactile-test") for _ in range(2))
    first.send(message(7))
    assert second.recv(1.0).arbitration_id == 7
    for bus in (first, second):
        close_bus(bus)


def test_a_missing_bus_sends_nothing_and_leaves_nothing_open(caplog) -> None:
    for call in (lambda: MissingBus().recv(0), lambda: MissingBus().send(message(1))):
        with pytest.raises(can.CanOperationError, match="could not be opened"):
            call()
    gc.collect()
    assert caplog.text == ""


HOLD = """
import sys
import serial
from tactile.can.bus import bus_lock
interface, channel = sys.argv[1:]
slcan = interface == "slcan"
with serial.Serial(channel, exclusive=True) if slcan else bus_lock(interface, channel):
    print("locked", flush=True)
    sys.stdin.readline()
"""


def held_elsewhere(interface: str, channel: str) -> "subprocess.Popen[str]":
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, interface, channel],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "locked\n"
    return process


def test_a_second_program_is_refused_until_the_first_has_ended(adapter) -> None:
    with held_elsewhere("socketcan", "can77") as other:
        with pytest.raises(BusNotOpened, match="used by another program of this kind"):
            open_bus("socketcan", "can77")
        with bus_lock("socketcan", "can78"):
            pass
        other.kill()
    with bus_lock("socketcan", "can77"):
        pass
    with held_elsewhere("slcan", adapter.path) as other:
        with pytest.raises(BusNotOpened, match="another program has it open"):
            open_bus("slcan", adapter.path)
        other.kill()
    close_bus(open_bus("slcan", adapter.path))


def test_a_refused_second_program_takes_no_message_from_the_first(slcan, adapter, tmp_path) -> None:
    by_another_name = tmp_path / "adapter"
    by_another_name.symlink_to(adapter.path)
    adapter.write(b"t1811AA\r")
    with pytest.raises(BusNotOpened, match="used by another program of this kind"):
        open_bus("slcan", str(by_another_name))
    assert [one.arbitration_id for one in received(slcan)] == [0x181]


def test_a_bit_rate_that_an_adapter_lacks_leaves_its_port_free(adapter) -> None:
    with pytest.raises(BusNotOpened, match="bitrate") as refused:
        open_bus("slcan", adapter.path, bitrate=800_000)
    handle = os.open(adapter.path, os.O_RDWR | os.O_NOCTTY)
    try:
        # As the driver locks it; the error above keeps all that it has seen alive.
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    finally:
        os.close(handle)
    assert refused.value.__cause__ is not None
