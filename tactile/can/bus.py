"""CAN buses, with corrections of python-can's drivers, and sources of their received messages.

python-can 4.6 reads a serial adapter byte by byte. It accepts some damaged lines as messages, and
others end its receive thread. Its buses have no lock against a second program. A subclass of its
driver and a lock correct this.

A source is a directly polled bus, or one supervised thread. Some adapters also return the messages
that the host sent; the sources drop them.
"""

import errno
import hashlib
import logging
import os
import re
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import partial
from itertools import islice
from typing import Any, NoReturn

import can
from can.interfaces.slcan import slcanBus

from tactile.clock import Clock
from tactile.errors import BusNotOpened, BusOff, LinkFault, ReceiveLoopDead

# What a driver logs when it cannot open is in the text of BusNotOpened.
logging.getLogger(can.__name__).setLevel(logging.ERROR)

CanBus = can.BusABC
"""An open bus, for callers that only pass it on."""

_NODE_BITS = 0x07F
"""Bits of the node-ID in a COB-ID (CiA 301, 7.3.5)."""
_SEND_TIMEOUT_S = 0.1
"""Longest wait in s until an adapter accepts a message: five frame periods at 50 Hz."""
_LONGEST_LINE = 32
"""The longest line of a classic message is T + 8 + 1 + 16 characters, its end and a time stamp."""
_MESSAGE = re.compile(
    "([tr][0-7][0-9A-Fa-f]{2}|[TR][01][0-9A-Fa-f]{7})([0-8])((?:[0-9A-Fa-f]{2})*)"
)
"""A message of slcan: identifier of 3 or 8 digits, length, data and time stamp."""
_STAMP_DIGITS = 4
_FLAGS = re.compile("F([0-9A-Fa-f]{2})")
"""Answer of a serial adapter to the command F."""
_TTY_BAUD = 1_000_000
"""Speed of the serial port of an adapter in baud; those on USB ignore it."""
_FLAG_PASSIVE = 0x20
_FLAGS_EVERY_S = 0.05
"""Period in s of that command: a tenth of the allowed time of a passive controller."""
_FLAGS_UNANSWERED = 10
"""Number of unanswered commands of an adapter without this command."""
CLASS_CONTROLLER, PASSIVE, ACTIVE = 0x04, 0x30, 0x40
"""Error frame of SocketCAN (linux/can/error.h): class of the identifier, and bits of data byte 1:
error-passive in receiving or sending, active again."""
_MESSAGE_KINDS = frozenset("tTrRdDbBx")
"""First letters of the driver's messages; d, D, b, B are CAN FD, x is not standard."""


class MissingBus(can.BusABC):
    """CAN bus that could not be opened: a placeholder until it is reopened."""

    def __init__(self) -> None:
        super().__init__(channel="missing")

    def send(self, msg: can.Message, timeout: float | None = None) -> NoReturn:
        """Raise CanOperationError."""
        raise can.CanOperationError("the CAN bus could not be opened")

    def recv(self, timeout: float | None = None) -> NoReturn:
        """Raise CanOperationError."""
        raise can.CanOperationError("the CAN bus could not be opened")


@contextmanager
def bus_lock(interface: str, channel: str) -> Iterator[None]:
    """Let one program at a time use a CAN interface; buses in one program need no lock.

    Without it two programs could command one control unit. A serial port also has a lock of its
    own, but to open one discards what has arrived for the program that holds it. The lock is a
    name among the sockets of the system (unix(7), abstract): a service with its own /tmp shares it,
    and the operating system releases it when the program ends. Raises BusNotOpened if another
    program holds it.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as lock:
        if interface != "virtual":
            place = os.path.realpath(channel) if "/" in channel else channel
            name = hashlib.sha256(f"{interface} {place}".encode()).hexdigest()
            try:
                lock.bind(f"\0can-{name}")
            except OSError as error:
                raise BusNotOpened(
                    f"CAN interface {interface!r}, channel {channel!r}, is used by another program "
                    "of this kind: end that program first"
                ) from error
        yield


def _message_of(line: str) -> can.Message | None:
    """Return the message in a line if its data have their length; a stamp may follow.

    python-can's own parsing accepts signs, blanks and underscores in numbers, identifiers beyond
    29 bits, and data that are shorter than their length.
    """
    match = _MESSAGE.fullmatch(line)
    if match is None:
        return None
    kind, dlc, remote = line[0], int(match[2]), line[0] in "rR"
    digits = 0 if remote else 2 * dlc
    if len(match[3]) not in (digits, digits + _STAMP_DIGITS):
        return None
    return can.Message(
        arbitration_id=int(match[1][1:], 16),
        is_extended_id=kind in "TR",
        is_remote_frame=remote,
        dlc=dlc,
        data=bytes.fromhex(match[3][:digits]),
    )


class BulkSlcanBus(slcanBus):
    """slcan that reads all available data at once, and tolerates damaged lines.

    Its base driver reads byte by byte (92 µs a message) and waits 2 s after opening. It waits
    without limit until the adapter accepts its output, and one bad character makes it raise on
    every call. Here bad lines are dropped and counted; a failing port still raises
    ``can.CanOperationError``. A serial adapter has no error frames, so its flags are read 20 times
    a second. If it becomes error-passive, or active again, this gives an error frame of SocketCAN.

    Parameters
    ----------
    bitrate
        CAN bit rate in bit/s.
    """

    def __init__(self, channel: str, *, bitrate: int) -> None:
        self._messages: deque[can.Message] = deque()
        self._passive = False
        self._flags_due_s = time.monotonic()
        self._flags_unanswered = 0
        self.bad_lines = 0
        super().__init__(
            channel, bitrate=bitrate, tty_baudrate=_TTY_BAUD, sleep_after_open=0.0, timeout=0.0
        )

    def set_bitrate(self, bitrate: int, data_bitrate: int | None = None) -> None:
        """Lock the port, then set the bit rate in bit/s: the first command to the adapter."""
        try:
            self.serialPortOrig.exclusive = True
            super().set_bitrate(bitrate, data_bitrate)
        except (OSError, ValueError):
            # The driver would keep the port open for itself.
            self.serialPortOrig.close()
            raise

    def _write(self, string: str) -> None:
        """Send a line; ``can.CanOperationError`` if the adapter takes nothing for 0.1 s.

        pyserial's own method also counts the time in which this process does not run.
        """
        data = string.encode("ascii") + self.LINE_TERMINATOR
        with can.exceptions.error_check("the serial port of the CAN adapter cannot be written"):
            port = self.serialPortOrig.fileno()
            while data:
                if not select.select([], [port], [], _SEND_TIMEOUT_S)[1]:
                    raise TimeoutError
                with suppress(BlockingIOError):  # another thread was faster
                    data = data[os.write(port, data) :]

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        self._ask_for_flags()
        if not self._messages:
            with can.exceptions.error_check("the serial port of the CAN adapter cannot be read"):
                if select.select([self.serialPortOrig.fileno()], [], [], timeout)[0]:
                    # Zero bytes on a readable port mean that its other end is gone: this raises.
                    self._buffer += self.serialPortOrig.read(self.serialPortOrig.in_waiting or 1)
            self._split()
        return (self._messages.popleft() if self._messages else None), False

    def _split(self) -> None:
        """Split received data into complete lines; of an overlong one the begin is kept."""
        *lines, rest = self._buffer.replace(b"\a", b"\r").split(b"\r")
        self._buffer = bytearray(rest[: _LONGEST_LINE + 1])
        for line in lines:
            text = line.decode("ascii", errors="replace")
            if flags := _FLAGS.fullmatch(text):
                self._take_flags(int(flags[1], 16))
            elif (message := _message_of(text)) is not None:
                self._messages.append(message)
            else:  # other lines answer commands
                self.bad_lines += text[:1] in _MESSAGE_KINDS or len(text) > _LONGEST_LINE

    def _ask_for_flags(self) -> None:
        now_s = time.monotonic()
        if now_s >= self._flags_due_s and self._flags_unanswered < _FLAGS_UNANSWERED:
            self._flags_due_s = now_s + _FLAGS_EVERY_S
            self._flags_unanswered += 1
            self._write("F")

    def _take_flags(self, flags: int) -> None:
        """Make an error frame if the controller became error-passive or active again."""
        self._flags_unanswered = 0
        passive = bool(flags & _FLAG_PASSIVE)
        if passive == self._passive:
            return
        self._passive = passive
        state = PASSIVE if passive else ACTIVE
        frame = can.Message(
            arbitration_id=CLASS_CONTROLLER,
            is_extended_id=False,
            is_error_frame=True,
            data=bytes((0, state, 0, 0, 0, 0, 0, 0)),
        )
        self._messages.append(frame)

    def shutdown(self) -> None:
        """Close channel and port; the port also if the adapter is gone."""
        try:
            super().shutdown()
        finally:
            self.serialPortOrig.close()


def open_bus(
    interface: str,
    channel: str,
    *,
    bitrate: int = 500_000,
    shared: bool = False,
    nodes: Sequence[int] = (),
) -> can.BusABC:
    """Open a CAN bus, without configuration files and environment variables of python-can.

    Raises BusNotOpened if the bus cannot be opened; the message names the checks.

    Parameters
    ----------
    interface
        python-can's name: ``socketcan``, ``slcan``, ``virtual``, ...
    channel
        Interface or port.
    bitrate
        CAN bit rate in bit/s. The system sets that of SocketCAN interfaces.
    shared
        Whether another part of this program has opened the interface and holds its lock; only
        ``socketcan`` can be opened twice.
    nodes
        CANopen node-IDs of the needed messages; ``socketcan`` drops the others. All by default.
    """
    with ExitStack() as opened:
        if not (shared and interface == "socketcan"):
            opened.enter_context(bus_lock(interface, channel))
        try:
            bus = _open(interface, channel, bitrate=bitrate)
            opened.callback(bus.shutdown)
            # Only the system's filter lets error frames pass.
            if nodes and interface == "socketcan":
                bus.set_filters([{"can_id": node, "can_mask": _NODE_BITS} for node in nodes])
        except Exception as error:
            # A driver without its library or its options raises errors of any kind.
            cause: object = error.__cause__ or error
            if isinstance(error, NameError):
                cause = "the library of its driver is missing"
            if getattr(cause, "errno", None) in (errno.EAGAIN, errno.EBUSY):
                cause = "another program has it open, end that program first"
            raise BusNotOpened(
                f"CAN interface {interface!r}, channel {channel!r}, cannot be opened: {cause}. "
                f"{_ADVICE.get(interface, _CHECK_NAMES)}"
            ) from error
        # The shutdown of the bus releases the lock.
        bus.shutdown = opened.pop_all().close  # type: ignore[method-assign]
        return bus


def _open(interface: str, channel: str, *, bitrate: int) -> can.BusABC:
    if interface == "slcan":
        return BulkSlcanBus(channel, bitrate=bitrate)
    options: dict[str, Any] = {"bitrate": bitrate}
    if interface == "socketcan":
        # Without this interface the driver would leave a socket open.
        socket.if_nametoindex(channel)
        options = {}
    # Drivers that number their adapters compare numbers with the channel.
    place = int(channel) if channel.isdecimal() else channel
    return can.Bus(place, interface=interface, ignore_config=True, **options)


_CHECK_NAMES = "Check the names of interface and channel, and that the driver is installed"
_ADVICE = {
    interface: f"Check that the adapter is plugged in and its driver is installed: {driver}"
    for interface, driver in {
        "gs_usb": "`pip install 'python-can[gs-usb]'` and libusb; the channel is its number from 0",
        "canalystii": "`pip install 'python-can[canalystii]'`",
        "cantact": "`pip install 'python-can[cantact]'`",
        "neovi": "`pip install 'python-can[neovi]'`",
        "kvaser": "the package linuxcan of Kvaser, with libcanlib.so",
        "pcan": "the package PCAN-Basic of PEAK, with libpcanbasic.so",
    }.items()
} | {
    "slcan": "Check that the adapter is plugged in, that the port is its port, that no other "
    "program has it open, and that you may read and write it (group dialout)",
    "socketcan": "Check `ip link`: the interface must exist and be up, with the bit rate set "
    "(ip link set CHANNEL up type can bitrate RATE)",
}
"""Advice by interface for a bus that cannot be opened."""


def bad_lines(bus: can.BusABC) -> int:
    """Return the number of damaged lines from a serial adapter; 0 for other buses."""
    return bus.bad_lines if isinstance(bus, BulkSlcanBus) else 0


def close_bus(bus: can.BusABC) -> None:
    """Close a bus in any state; errors of a missing adapter are ignored."""
    with suppress(can.CanError, OSError):
        bus.shutdown()


Stamped = tuple[float, can.Message]
"""Monotonic time of reception in s, and the message."""
_POLL_S = 0.0005
"""Longest pause in s between two polls of a bus or a queue: four messages at 1 Mbit/s."""
_RECEIVE_S = 0.05
"""Longest wait in s of the thread for a message, which also limits the delay of its end."""
_HANG_S = 1.0
"""Longest time in s of one loop of the thread; a longer one counts as hung."""
_JOIN_S = 2.0
"""Longest wait in s for the end of the thread."""


def of_another_kind(message: can.Message) -> bool:
    """Return whether a message has a 29-bit identifier or is a request (RTR): of other devices."""
    return message.is_extended_id or message.is_remote_frame


def interface_failed(error: Exception) -> BusOff:
    """Return the fault for an error of a CAN interface."""
    return BusOff(
        f"the CAN interface failed: {str(error) or type(error).__name__}; "
        "check that the adapter is plugged in and its interface is up; the next start opens it anew"
    )


class PolledSource:
    """Source that polls the bus in the caller's thread: for buses in memory, in virtual time.

    A bus of this kind stamps its messages by the same clock. Without a stamp the time of the poll
    is used.

    Parameters
    ----------
    limit
        Most messages returned at once, so that a flooded bus does not block the caller.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, *, limit: int = 4096) -> None:
        self._bus = bus
        self.clock = clock
        """The real clock, or that of a simulated bus with its devices."""
        self._limit = limit
        # A bus in memory has a method for all arrived messages, which is faster than one by one.
        self._recv_all: Callable[[int], list[can.Message]] = getattr(
            bus, "recv_all", lambda most: list(islice(iter(partial(bus.recv, 0), None), most))
        )

    def start(self) -> None:
        """Discard earlier messages."""
        while self.drain():
            pass

    def drain(self) -> list[Stamped]:
        """Return all messages since the last call."""
        now_s = self.clock.monotonic()
        try:
            messages = self._recv_all(self._limit)
        except (can.CanError, OSError) as error:
            raise interface_failed(error) from error
        return [
            (m.timestamp if 0.0 < m.timestamp <= now_s else now_s, m) for m in messages if m.is_rx
        ]

    def wait(self, timeout_s: float) -> None:
        """Sleep for a short while, at most ``timeout_s``."""
        self.clock.sleep(min(timeout_s, _POLL_S))

    def close(self) -> None:
        """Nothing to stop."""


class ThreadedReceiver(PolledSource):
    """Source with one thread that stamps and queues messages; the end of the thread is a fault.

    Parameters
    ----------
    bus
        An open bus whose ``recv`` may block.
    limit
        Size of the queue; the receiver gives up when it is full.
    """

    def __init__(self, bus: can.BusABC, clock: Clock, *, limit: int = 20_000) -> None:
        super().__init__(bus, clock, limit=limit)
        self._queue: deque[Stamped] = deque()
        self._stop = threading.Event()
        self._fault: BusOff | ReceiveLoopDead | None = None
        self._thread: threading.Thread | None = None
        self._alive_s = 0.0

    def start(self) -> None:
        """Start the thread; earlier messages of the bus are discarded."""
        PolledSource(self._bus, self.clock).start()
        self._queue.clear()
        self._stop.clear()
        self._fault = None
        self._alive_s = self.clock.monotonic()
        self._thread = threading.Thread(target=self._run, name="tactile-receive", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                message = self._bus.recv(_RECEIVE_S)
                self._alive_s = self.clock.monotonic()
                if message is None or not message.is_rx:
                    continue
                if len(self._queue) >= self._limit:
                    self._fault = ReceiveLoopDead(
                        f"{self._limit} CAN messages wait to be processed: the host is too slow "
                        "or the bus is flooded; start the link again"
                    )
                    return
                self._queue.append((self._alive_s, message))
        except (can.CanError, OSError) as error:
            self._fault = interface_failed(error)
        except Exception as error:
            self._fault = ReceiveLoopDead(
                f"the receive thread ended ({error!r}); start the link again"
            )
            self._fault.__cause__ = error

    def drain(self) -> list[Stamped]:
        """Return all messages since the last call."""
        if self._thread is None:
            raise ReceiveLoopDead("the receive thread is not running; start the link")
        if self._fault is not None:
            raise self._fault
        silent_s = self.clock.monotonic() - self._alive_s
        if silent_s > _HANG_S:
            raise ReceiveLoopDead(
                f"the receive thread did not come round for {silent_s:.2f} s, allowed are "
                f"{_HANG_S:g} s: the CAN driver or this process hung; replug the adapter and start"
            )
        queue = self._queue
        return [queue.popleft() for _ in range(len(queue))]

    def close(self) -> None:
        """End the thread and wait for it, at most 2 s."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(_JOIN_S)
            self._thread = None


def reopened(
    bus: can.BusABC, fault: LinkFault | None, reopen: Callable[[], can.BusABC] | None
) -> can.BusABC:
    """Return the bus for a new start; one that is missing, or was lost by a fault, is reopened."""
    lost = isinstance(bus, MissingBus) or isinstance(fault, BusOff | ReceiveLoopDead)
    return reopen() if lost and reopen is not None else bus


def message_source(bus: can.BusABC) -> PolledSource:
    """Return what receives the messages of a bus.

    It is a thread in real time, and the caller who polls under the clock of a simulated bus.
    """
    clock: Clock = getattr(bus, "clock", time)
    return (ThreadedReceiver if clock is time else PolledSource)(bus, clock)
