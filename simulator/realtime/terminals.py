"""Pseudo-terminals of simulated lines: servo bus, serial CAN adapter, sensor boards.

They have no loop: the owner waits until the descriptor is readable or the next event is due, and
calls ``poll``.
"""

import fcntl
import math
import os
import struct
import termios
import tty
from contextlib import suppress
from pathlib import Path

from simulator.errors import EndpointError
from simulator.servo.bus import SerialDevice

_READ_SIZE = 4096
"""Most bytes per read from a client."""
_BAUD_BY_CONSTANT: dict[int, int] = {
    value: int(name[1:])
    for name, value in vars(termios).items()
    if name.startswith("B") and name[1:].isdigit() and int(name[1:]) > 0
}
"""Line rate in baud of constants of termios such as B115200."""
_OUTPUT_SPEED = 5
"""Position of the output speed in the result of `termios.tcgetattr`."""
_SPEED_IN_NUMBERS = 0o10000
"""BOTHER of asm-generic/termbits.h: termios2 has the rate as a number; clients in Rust set it."""
_TCGETS2 = 0x802C542A
"""Request that reads termios2 (asm-generic/ioctls.h)."""
_TERMIOS2 = struct.Struct("=4IB19s2I")
"""Structure termios2: four flags, line discipline, 19 control characters, both speeds."""


class SerialPty:
    """The host's end of a serial line as a pseudo-terminal, for clients in other processes.

    It has a stable link; it may be removed and come back with a new name. While the client does not
    read, the device keeps its bytes.

    Parameters
    ----------
    link
        Symbolic link to the current terminal. An existing symbolic link is replaced; any other
        existing file is an EndpointError.
    """

    def __init__(self, device: SerialDevice, link: Path) -> None:
        self._link = link
        self.path = str(link)
        """Path for clients: the link."""
        self._name = ""
        self._device = device
        self._unsent = b""
        self._polled_s: float | None = None
        self.master_fd = -1
        self.slave_fd = -1
        self._plug_in()

    @property
    def plugged_in(self) -> bool:
        """Whether the terminal exists."""
        return self.master_fd >= 0

    def fileno(self) -> int:
        """Return the descriptor to wait on; negative while unplugged."""
        return self.master_fd

    def _plug_in(self) -> None:
        """Create a terminal and its link. Raises EndpointError if the system refuses."""
        try:
            # The client's side is kept open here too: else the terminal fails between clients.
            self.master_fd, self.slave_fd = os.openpty()
            os.set_blocking(self.master_fd, False)
            tty.setraw(self.slave_fd)
            self._name = os.ttyname(self.slave_fd)
            self._make_link()
        except OSError as error:
            self.close()
            raise EndpointError(f"no terminal at {self._link}: {error}") from error

    def close(self) -> None:
        """Remove terminal and link; a second call has no effect."""
        for descriptor in (self.master_fd, self.slave_fd):
            if descriptor >= 0:
                os.close(descriptor)
        self.master_fd = self.slave_fd = -1
        if self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()

    def _make_link(self) -> None:
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} exists and is not a symbolic link")
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._name)
        fresh.replace(self._link)

    @property
    def client_baudrate(self) -> int:
        """Line rate in baud set by the client, as constant or number; 0: hung up."""
        speed = termios.tcgetattr(self.slave_fd)[_OUTPUT_SPEED]
        if speed == _SPEED_IN_NUMBERS:
            raw = fcntl.ioctl(self.slave_fd, _TCGETS2, bytes(_TERMIOS2.size))
            return int(_TERMIOS2.unpack(raw)[-1])
        return _BAUD_BY_CONSTANT.get(speed, 0)

    def poll(self, now_s: float) -> float:
        """Transfer bytes both ways without waiting; return the time of the next bytes in s.

        Bytes may have waited since the last call. After a stall the owner polls before it advances
        the servos, so that no watchdog trips although a packet came in time.

        An unplugged device has no terminal: a client with an open one gets input/output errors.
        Raises EndpointError if the system refuses a new one.
        """
        if self._device.unplugged and self.plugged_in:
            # The adapter has lost its supply, and with it the bytes in transit.
            self._unsent = b""
            self.close()
        elif not (self._device.unplugged or self.plugged_in):
            self._plug_in()
        if not self.plugged_in:
            self._device.transmit(now_s)
            self._device.drop_pending()
            return self._device.next_event_s()
        data = b""
        with suppress(BlockingIOError):
            data = os.read(self.master_fd, _READ_SIZE)
        if data and (baudrate := self.client_baudrate):
            self._device.baudrate = baudrate
            self._device.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        if not self._unsent:
            self._unsent = self._device.transmit(now_s)
        if self._unsent:
            with suppress(BlockingIOError):
                self._unsent = self._unsent[os.write(self.master_fd, self._unsent) :]
        # A full terminal is looked at again with the next step of the world.
        return math.inf if self._unsent else self._device.next_event_s()


class BoardPty(SerialPty):
    """The host's end of a sensor board, which also sends without a reader."""

    def poll(self, now_s: float) -> float:
        """Transfer bytes as `SerialPty`; bytes that do not fit into the terminal are lost."""
        super().poll(now_s)
        self._unsent = b""
        return self._device.next_event_s() if self.plugged_in else math.inf
