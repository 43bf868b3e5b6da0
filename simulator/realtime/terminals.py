"""Pseudo-terminals that lead to simulated adapters: the servo bus and the serial CAN adapter.

Neither has a loop of its own: its owner waits until the descriptor is readable or the next event is
due, and calls ``poll``.
"""

import fcntl
import os
import struct
import termios
import tty
from collections.abc import Callable
from pathlib import Path

from simulator.can.slcan import SlcanAdapter
from simulator.errors import EndpointError, SimulatorStateError
from simulator.servo.bus import SerialDevice

_READ_SIZE = 4096
"""Most bytes that are read of a client at once."""
_BAUD_BY_CONSTANT: dict[int, int] = {
    value: int(name[1:])
    for name, value in vars(termios).items()
    if name.startswith("B") and name[1:].isdigit() and int(name[1:]) > 0
}
"""Line rate in baud of termios' constants, as B115200."""
_OUTPUT_SPEED = 5
"""Position of the output speed in what `termios.tcgetattr` returns."""
_SPEED_IN_NUMBERS = 0o10000
"""BOTHER of asm-generic/termbits.h: the rate stands as a number in the newer structure."""
_TCGETS2 = 0x802C542A
"""Request that reads that structure (asm-generic/ioctls.h)."""
_TERMIOS2 = struct.Struct("=4IB19s2I")
"""That structure: four flags, line discipline, 19 control characters, input and output speed."""


class Terminal:
    """One pseudo-terminal behind a stable link; it may go and come back under a new name.

    Parameters
    ----------
    link_path
        Symbolic link that always names the current terminal; None makes none. An existing symbolic
        link is replaced, anything else is an EndpointError.
    """

    def __init__(self, what: str, link_path: Path | None) -> None:
        self._what = what
        self._link = link_path
        self._name = ""
        self.master_fd = -1
        self.slave_fd = -1

    @property
    def path(self) -> str:
        """Path that a client opens: the link, or the terminal itself without one."""
        return self._name if self._link is None else str(self._link)

    @property
    def plugged_in(self) -> bool:
        """Whether the terminal is there."""
        return self.master_fd >= 0

    def fileno(self) -> int:
        """Return the descriptor to wait on, SimulatorStateError while there is none."""
        if not self.plugged_in:
            raise SimulatorStateError(f"{self._what} is unplugged and has no descriptor")
        return self.master_fd

    def open(self) -> None:
        """Make the terminal and let the link name it; EndpointError where that is refused."""
        try:
            # The own end of the client's side stays open: else the terminal fails between clients.
            self.master_fd, self.slave_fd = os.openpty()
            os.set_blocking(self.master_fd, False)
            tty.setraw(self.slave_fd)
            self._name = os.ttyname(self.slave_fd)
            self._make_link()
        except OSError as error:
            self.close()
            raise EndpointError(f"no terminal for {self._what}: {error}") from error

    def plug_in(self) -> None:
        """Make a terminal, under a new name after `unplug`, and let the link name it."""
        if not self.plugged_in:
            self.open()

    def unplug(self) -> Callable[[], None]:
        """Take the terminal away; a client that has it open gets input/output errors.

        Returns `plug_in`.
        """
        self._forget()
        self.close()
        return self.plug_in

    def _forget(self) -> None:
        """Drop what is under way: the adapter has lost its supply."""

    def close(self) -> None:
        """Take terminal and link away; closing again changes nothing."""
        for descriptor in (self.master_fd, self.slave_fd):
            if descriptor >= 0:
                os.close(descriptor)
        self.master_fd = self.slave_fd = -1
        link = self._link
        if link is not None and link.is_symlink() and os.readlink(link) == self._name:
            link.unlink()

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes of the client, none where there are none."""
        try:
            return os.read(self.master_fd, size)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> int:
        """Send bytes to the client and return how many it took."""
        try:
            return os.write(self.master_fd, data)
        except BlockingIOError:
            return 0

    def _make_link(self) -> None:
        if self._link is None:
            return
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} exists and is not a symbolic link")
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._name)
        fresh.replace(self._link)


class ServoPty(Terminal):
    """The host's end of a serial line as a pseudo-terminal, for clients in other processes."""

    what = "the servos"

    def __init__(self, device: SerialDevice, link_path: str | Path | None = None) -> None:
        super().__init__(self.what, None if link_path is None else Path(link_path))
        self._device = device
        self._unsent = b""
        self._polled_s: float | None = None
        self.plug_in()

    @property
    def client_baudrate(self) -> int:
        """Line rate in baud that the client has set, by a constant or as a number; 0 = hung up."""
        speed = termios.tcgetattr(self.slave_fd)[_OUTPUT_SPEED]
        if speed == _SPEED_IN_NUMBERS:
            raw = fcntl.ioctl(self.slave_fd, _TCGETS2, bytes(_TERMIOS2.size))
            return int(_TERMIOS2.unpack(raw)[-1])
        return _BAUD_BY_CONSTANT.get(speed, 0)

    def poll(self, now_s: float) -> float | None:
        """Move bytes both ways without waiting; return when the next ones are due, None if never.

        Bytes that are found may have waited since the last call. An owner that stalls polls before
        it advances the servos, so that no watchdog trips over a packet that was there in time.
        """
        if not self.plugged_in:
            return None
        data = self.read(_READ_SIZE)
        if data:
            baudrate = self.client_baudrate
            if baudrate:
                self._device.baudrate = baudrate
                self._device.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        self._unsent += self._device.transmit(now_s)
        if self._unsent:
            self._unsent = self._unsent[self.write(self._unsent) :]
        return now_s if self._unsent else self._device.next_event_s()

    def _forget(self) -> None:
        self._device.drop_pending()
        self._unsent = b""


class BoardPty(ServoPty):
    """The host's end of a sensor board, which goes on sending where nobody takes its bytes."""

    what = "the sensor board"

    def poll(self, now_s: float) -> float | None:
        """Move bytes as `ServoPty`; what does not fit into the terminal is lost."""
        super().poll(now_s)
        self._unsent = b""
        return self._device.next_event_s() if self.plugged_in else None


class SlcanPty(Terminal):
    """The serial CAN adapter as a pseudo-terminal, for clients in other processes."""

    def __init__(self, adapter: SlcanAdapter, link_path: Path | None = None) -> None:
        super().__init__("the CAN adapter", link_path)
        self._adapter = adapter
        self._polled_s: float | None = None
        self.plug_in()

    def poll(self, now_s: float) -> float:
        """Move bytes both ways without waiting; return when the next ones are due, in s."""
        if self.plugged_in:
            self._move(now_s)
        else:
            self._adapter.transmit(now_s)
            self._adapter.reset()
        return self._adapter.next_event_s()

    def _forget(self) -> None:
        self._adapter.reset()

    def _move(self, now_s: float) -> None:
        data = self.read(_READ_SIZE)
        if data:
            self._adapter.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        output = self._adapter.transmit(now_s)
        if output:
            sent = self.write(output)
            if sent < len(output):
                self._adapter.put_back(output[sent:])
