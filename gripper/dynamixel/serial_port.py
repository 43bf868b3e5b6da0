"""Serial port of the servo bus, as a stream of bytes with a lock of its file."""

import errno
import os
import select
import termios
import time
from contextlib import suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from gripper.clock import Clock
from gripper.dynamixel.control_table import BAUD_CODES
from gripper.dynamixel.protocol2 import ByteStream
from gripper.errors import LimitExceeded, PortLost

_WRITE_TIMEOUT_S = 0.1
"""Longest time in s for which a port may take no byte: 10,000 bytes at 1 Mbit/s."""
_PORT_ERRORS = (serial.SerialException, OSError, termios.error)
"""Errors of pyserial and the operating system for a missing, used or lost port."""


def open_line(port: str | ByteStream, baudrate: int) -> tuple[ByteStream, Clock]:
    """Return the bytes and the time of a serial port, or of a line that is open already.

    A line to simulated servos has their time with it, as ``clock``. Raises PortLost and
    LimitExceeded as `SerialStream`.
    """
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

    Raises PortLost when the port is missing, used or not permitted; the message names the remedy.
    Raises LimitExceeded when servos do not support the baud rate.

    Parameters
    ----------
    path
        Device, such as /dev/ttyUSB0 or a link below /dev/serial/by-id.
    baudrate
        One of `gripper.dynamixel.control_table.BAUD_CODES`.
    """

    def __init__(self, path: str, baudrate: int = 1_000_000) -> None:
        if baudrate not in BAUD_CODES:
            raise LimitExceeded(
                f"baud rate {baudrate} is not supported; use {', '.join(map(str, BAUD_CODES))}"
            )
        self.path = path
        try:
            self._serial = serial.Serial(path, baudrate, timeout=0, exclusive=True)
        except _PORT_ERRORS as error:
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
