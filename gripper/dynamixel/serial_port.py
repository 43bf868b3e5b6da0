"""Serial port of the servo bus: a stream of bytes, its lock file, and a port for the SDK.

A read blocks until a byte arrives; the SDK's own port polls.
"""

import errno
import os
import select
import termios
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

import serial
from serial.tools import list_ports

from gripper.clock import Clock
from gripper.dynamixel.control_table import BAUD_CODES
from gripper.errors import LimitExceeded, PortLost

_WRITE_TIMEOUT_S = 0.1
"""Longest time in s for which a port may take no byte: 10,000 bytes at 1 Mbit/s."""
_TIMER_GRAIN_S = 1e-6
"""Margin in s by which a time-out ends early, for the rounding of floats."""
_LONGEST_PACKET = 1031
"""Bytes of the longest packet that the SDK accepts."""
_READ_AHEAD = 256
"""Bytes per read: answers that arrived together are read together."""
_PORT_ERRORS = (serial.SerialException, OSError, termios.error)
"""Errors of pyserial and the operating system for a missing, used or lost port."""


class ByteStream(Protocol):
    """Both directions of a serial line; raises OSError or PortLost when it is lost."""

    def write(self, data: bytes, /) -> None:
        """Send all bytes."""

    def read(self, size: int, timeout_s: float, /) -> bytes:
        """Return 1 to ``size`` bytes as soon as any is there, b"" after ``timeout_s`` s."""

    def drop_input(self) -> None:
        """Forget what has arrived and was not read."""

    def close(self) -> None:
        """Give the line back; may be called twice."""


def open_line(port: str | ByteStream, baudrate: int) -> tuple[ByteStream, Clock]:
    """Return the bytes and the time of a serial port, or of a line that is open already.

    A line to simulated servos has their time with it, as ``clock``. Raises PortLost as
    `SerialStream`, and LimitExceeded when servos do not support the baud rate.
    """
    if baudrate not in BAUD_CODES:
        rates = ", ".join(map(str, BAUD_CODES))
        raise LimitExceeded(f"baud rate {baudrate} is not one of servos; use {rates}")
    stream = SerialStream(port, baudrate) if isinstance(port, str) else port
    clock: Clock = getattr(stream, "clock", time)
    return stream, clock


def serial_candidates() -> tuple[str, ...]:
    """Return the paths of the serial ports that the operating system lists."""
    return tuple(sorted(port.device for port in list_ports.comports()))


def latency_timer_file(path: str) -> Path:
    """Return where the system keeps the latency timer of a USB adapter, if it has one."""
    name = Path(os.path.realpath(path)).name
    return Path(f"/sys/bus/usb-serial/devices/{name}/latency_timer")


def latency_timer_ms(path: str) -> int | None:
    """Return the latency timer of a port's USB adapter in ms, None where the system shows none.

    More than 1 ms makes each answer wait that long (FTDI adapters start with 16 ms).
    """
    try:
        return int(latency_timer_file(path).read_text("ascii"))
    except OSError:
        return None


class SerialStream:
    """A serial port of the operating system for one program, which a lock of its file excludes.

    Raises PortLost when the port is missing, used or not permitted, or does not support the baud
    rate; the message names the remedy.

    Parameters
    ----------
    path
        Device, such as /dev/ttyUSB0 or a link below /dev/serial/by-id.
    baudrate
        Baud rate; boards have others than servos.
    """

    def __init__(self, path: str, baudrate: int = 1_000_000) -> None:
        self.path = path
        try:
            self._serial = serial.Serial(path, baudrate, timeout=0, exclusive=True)
        except (*_PORT_ERRORS, ValueError, OverflowError) as error:
            raise PortLost(_opening_failed(path, error)) from error
        # The driver hands bytes on at once; not every driver can.
        with suppress(ValueError, AttributeError, NotImplementedError, *_PORT_ERRORS):
            self._serial.set_low_latency_mode(True)

    def __str__(self) -> str:
        return self.path

    def write(self, data: bytes, /) -> None:
        """Send all bytes; PortLost when the line is gone, or takes no more for 0.1 s.

        pyserial's own method counts the time in which this process does not run: a program that was
        stopped would lose a port that has taken all bytes.
        """
        try:
            while True:
                with suppress(BlockingIOError):
                    data = data[os.write(self._serial.fileno(), data) :]
                if not data:
                    return
                if not select.select([], [self._serial.fileno()], [], _WRITE_TIMEOUT_S)[1]:
                    raise self._lost("it takes no data")
        except _PORT_ERRORS as error:
            raise self._lost(error) from error

    def read(self, size: int, timeout_s: float, /) -> bytes:
        """Return 1 to ``size`` bytes as soon as any is there, b"" after ``timeout_s`` s."""
        try:
            ready, _, _ = select.select([self._serial.fileno()], [], [], max(0.0, timeout_s))
            if not ready:
                return b""
            data = os.read(self._serial.fileno(), size)
        except (*_PORT_ERRORS, ValueError) as error:
            raise self._lost(error) from error
        if not data:
            raise self._lost("end of file")
        return data

    def drop_input(self) -> None:
        """Forget what has arrived and was not read."""
        try:
            self._serial.reset_input_buffer()
        except _PORT_ERRORS as error:
            raise self._lost(error) from error

    def close(self) -> None:
        """Give the port back; a port that is gone is closed without an error."""
        with suppress(*_PORT_ERRORS):
            self._serial.close()

    def _lost(self, cause: object) -> PortLost:
        return PortLost(
            f"serial port {self.path} is lost ({cause}): check cable and supply of the adapter, "
            f"then clear the fault, which reopens the port. A part may still be gripped"
        )


def _opening_failed(path: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EWOULDBLOCK, errno.EBUSY):
        return f"serial port {path} is used by another program: end that program first"
    if number in (errno.EACCES, errno.EPERM):
        return (
            f"no right to open serial port {path} ({error}): add the user to the group that "
            f"owns the device (often dialout) and log in again"
        )
    ports = ", ".join(serial_candidates()) or "none"
    return (
        f"cannot open serial port {path} ({error}): check the path and that the adapter is "
        f"plugged in. Serial ports found: {ports}"
    )


class SdkPort:
    """Port of the SDK's packet handler on any `ByteStream`, with blocking reads and monotonic time.

    The time-out of a packet has three parts: time on the wire, return delay of the servo, and an
    allowance for adapter and operating system. Bytes that arrived while the program was stopped
    are still read; if bytes arrive without a pause, reading ends one longest packet after that.

    Parameters
    ----------
    baudrate
        Baud rate in bit/s that the line has; 10 bits a byte.
    return_delay_s
        Return Delay Time of the slowest servo (register 9) in s.
    """

    def __init__(
        self,
        stream: ByteStream,
        clock: Clock,
        *,
        baudrate: int = 1_000_000,
        return_delay_s: float = 0.0005,
        allowance_s: float = 0.0015,
    ) -> None:
        self._clock = clock
        self._byte_s = 10.0 / baudrate
        self.return_delay_s = return_delay_s
        self.allowance_s = self.least_allowance_s = allowance_s
        """Allowance for adapter and operating system in s, and the one that it never falls below.
        """
        self.passed = bytearray()
        """Bytes that were read; the reader clears them."""
        self.use(stream)

    def use(self, stream: ByteStream) -> None:
        """Replace a lost stream."""
        self._stream = stream
        self.is_using = False
        self._unanswered_bytes = 0
        self._ahead = b""
        self._deadline_s = self._end_s = 0.0

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()

    def clearPort(self) -> None:  # noqa: N802
        """Forget what has arrived."""
        self._ahead = b""
        self._call(self._stream.drop_input)

    def writePort(self, packet: Sequence[int]) -> int:  # noqa: N802
        """Send a packet and return its length."""
        self._unanswered_bytes = len(packet)
        self._call(self._stream.write, bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Return up to ``length`` bytes, waiting no longer than the packet's time-out."""
        if length <= 0:
            return b""
        if not self._ahead:
            now_s = self._clock.monotonic()
            left_s = max(0.0, self._deadline_s - now_s)
            if left_s <= 0.0:
                self._end_s = self._end_s or now_s + _LONGEST_PACKET * self._byte_s
                if now_s > self._end_s:
                    return b""
            self._ahead = self._call(self._stream.read, max(length, _READ_AHEAD), left_s)
        data, self._ahead = self._ahead[:length], self._ahead[length:]
        self.passed += data
        return data

    def unread(self, length: int) -> None:
        """Let the last bytes be read again."""
        if length:
            self._ahead = bytes(self.passed[-length:]) + self._ahead
            del self.passed[-length:]

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Start the time-out for an answer of that many bytes."""
        wire_s = self._byte_s * (packet_length + self._unanswered_bytes)
        self._unanswered_bytes = 0
        self.start_timeout(wire_s + self.return_delay_s + self.allowance_s)

    def start_timeout(self, duration_s: float) -> None:
        """Start a time-out in s."""
        self._deadline_s, self._end_s = self._clock.monotonic() + duration_s, 0.0

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Return whether the packet's time-out is over, and nothing is left to read."""
        return not self._ahead and self._clock.monotonic() >= self._deadline_s - _TIMER_GRAIN_S

    def _call(self, method: Callable[..., Any], *args: object) -> Any:
        """Call a method of the stream. Raises PortLost for an OSError."""
        try:
            return method(*args)
        except OSError as error:
            raise PortLost(f"the servo line is lost: {error}") from error
