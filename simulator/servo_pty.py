"""The host's end of the servo bus as a pseudo-terminal, for clients in other processes.

The endpoint has no loop of its own: whoever owns it waits until its descriptor is readable or its
next event is due, and calls `ServoPty.poll`.
"""

import fcntl
import struct
import termios
from pathlib import Path

from simulator.servo_bus import ServoBusDevice
from simulator.terminal import Terminal

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
        self._terminal = Terminal("the servos", None if link_path is None else Path(link_path))
        self._unsent = b""
        self._polled_s: float | None = None
        self.plug_in()

    @property
    def port(self) -> str:
        """Path that a client opens."""
        return self._terminal.path

    @property
    def plugged_in(self) -> bool:
        """Whether the terminal exists."""
        return self._terminal.exists

    @property
    def client_baudrate(self) -> int:
        """Line rate in baud that the client has set, by a constant or as a number; 0 = hung up."""
        speed = termios.tcgetattr(self._terminal.slave_fd)[_OUTPUT_SPEED]
        if speed == _SPEED_IN_NUMBERS:
            raw = fcntl.ioctl(self._terminal.slave_fd, _TCGETS2, bytes(_TERMIOS2.size))
            return int(_TERMIOS2.unpack(raw)[-1])
        return _BAUD_BY_CONSTANT.get(speed, 0)

    def fileno(self) -> int:
        """Return the descriptor to wait on, SimulatorStateError while unplugged."""
        return self._terminal.fileno()

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
        data = self._terminal.read(_READ_SIZE)
        if data:
            baudrate = self.client_baudrate
            if baudrate:
                self._device.baudrate = baudrate
                self._device.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        self._unsent += self._device.transmit(now_s)
        if self._unsent:
            self._unsent = self._unsent[self._terminal.write(self._unsent) :]
        return now_s if self._unsent else self._device.next_event_s()

    def unplug(self) -> None:
        """Take the terminal away; a client that has it open gets input/output errors."""
        self._device.faults.unplugged = True
        self._device.drop_pending()
        self._terminal.close()

    def plug_in(self) -> None:
        """Make a terminal, under a new name after `unplug`, and let the link name it."""
        if self.plugged_in:
            return
        self._terminal.open()
        self._unsent = b""
        self._device.faults.unplugged = False

    def close(self) -> None:
        """Give terminal and link back; closing again changes nothing."""
        self._terminal.close()
