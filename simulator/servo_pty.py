"""The host's end of the servo bus as a pseudo-terminal, for clients in other processes.

The endpoint has no loop of its own: whoever owns it waits until its descriptor is readable or its
next event is due, and calls `ServoPty.poll`.
"""

import fcntl
import os
import struct
import termios
import tty
from pathlib import Path

from simulator.errors import EndpointError, SimulatorStateError
from simulator.servo_bus import ServoBusDevice

_READ_SIZE = 4096
_BAUD_BY_CONSTANT: dict[int, int] = {
    value: int(name[1:])
    for name, value in vars(termios).items()
    if name.startswith("B") and name[1:].isdigit() and int(name[1:]) > 0
}
_OUTPUT_SPEED = 5
_SPEED_IN_NUMBERS = 0o10000
"""BOTHER of asm-generic/termbits.h: the rate stands as a number in the newer structure."""
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("=4IB19s2I")


class ServoPty:
    """A pseudo-terminal that leads to simulated servos.

    Parameters
    ----------
    device
        The servos.
    link_path
        Symbolic link that always names the current terminal; None makes none. An existing
        symbolic link is replaced, anything else is an EndpointError.

    Attributes
    ----------
    port
        Path that a client opens: the link, or the terminal itself without one.
    """

    def __init__(self, device: ServoBusDevice, link_path: str | Path | None = None) -> None:
        self._device = device
        self._link = None if link_path is None else Path(link_path)
        self._master_fd = -1
        self._slave_fd = -1
        self._slave_name = ""
        self._unsent = b""
        self._polled_s: float | None = None
        self.plug_in()

    @property
    def port(self) -> str:
        """Path that a client opens."""
        return self._slave_name if self._link is None else str(self._link)

    @property
    def plugged_in(self) -> bool:
        """Whether the terminal exists."""
        return self._master_fd >= 0

    @property
    def client_baudrate(self) -> int:
        """Line rate in baud that the client has set, by a constant or as a number; 0 = hung up."""
        speed = termios.tcgetattr(self._slave_fd)[_OUTPUT_SPEED]
        if speed == _SPEED_IN_NUMBERS:
            raw = fcntl.ioctl(self._slave_fd, _TCGETS2, bytes(_TERMIOS2.size))
            return int(_TERMIOS2.unpack(raw)[-1])
        return _BAUD_BY_CONSTANT.get(speed, 0)

    def fileno(self) -> int:
        """Return the descriptor to wait on, SimulatorStateError while unplugged."""
        if not self.plugged_in:
            raise SimulatorStateError("the servo terminal is unplugged and has no descriptor")
        return self._master_fd

    def poll(self, now_s: float) -> float | None:
        """Move bytes both ways without waiting; return when the next ones are due, None if never.

        Bytes that are found may have waited since the last call. An owner that stalls polls before
        it advances the servos, so that no watchdog trips over a packet that was there in time.

        Parameters
        ----------
        now_s
            Monotonic time in s.
        """
        if not self.plugged_in:
            return None
        data = self._read()
        if data:
            baudrate = self.client_baudrate
            if baudrate:
                self._device.baudrate = baudrate
                self._device.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        self._unsent += self._device.transmit(now_s)
        if self._unsent:
            self._write()
        return now_s if self._unsent else self._device.next_event_s()

    def unplug(self) -> None:
        """Take the terminal away; a client that has it open gets input/output errors."""
        self._device.faults.unplugged = True
        self._device.drop_pending()
        self._close_descriptors()
        self._remove_link()

    def plug_in(self) -> None:
        """Make a terminal, under a new name after `unplug`, and let the link name it."""
        if self.plugged_in:
            return
        try:
            self._master_fd, self._slave_fd = os.openpty()
            os.set_blocking(self._master_fd, False)
            tty.setraw(self._slave_fd)
            self._slave_name = os.ttyname(self._slave_fd)
            self._make_link()
        except OSError as error:
            self._close_descriptors()
            raise EndpointError(f"no terminal for the servos: {error}") from error
        self._unsent = b""
        self._device.faults.unplugged = False

    def close(self) -> None:
        """Give terminal and link back; closing again changes nothing."""
        self._close_descriptors()
        self._remove_link()

    def _read(self) -> bytes:
        try:
            return os.read(self._master_fd, _READ_SIZE)
        except BlockingIOError:
            return b""

    def _write(self) -> None:
        try:
            sent = os.write(self._master_fd, self._unsent)
        except BlockingIOError:
            return
        self._unsent = self._unsent[sent:]

    def _make_link(self) -> None:
        if self._link is None:
            return
        if self._link.exists() and not self._link.is_symlink():
            raise FileExistsError(f"{self._link} exists and is not a symbolic link")
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._slave_name)
        fresh.replace(self._link)

    def _remove_link(self) -> None:
        link = self._link
        if link is not None and link.is_symlink() and os.readlink(link) == self._slave_name:
            link.unlink()

    def _close_descriptors(self) -> None:
        for descriptor in (self._master_fd, self._slave_fd):
            if descriptor >= 0:
                os.close(descriptor)
        self._master_fd = self._slave_fd = -1
