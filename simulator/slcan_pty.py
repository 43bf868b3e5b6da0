"""The serial CAN adapter as a pseudo-terminal, for clients in other processes.

It has no loop of its own: whoever owns it waits until its descriptor is readable or its next event
is due, and calls `SlcanPty.poll`.
"""

import os
import tty
from pathlib import Path

from simulator.errors import EndpointError, SimulatorStateError
from simulator.slcan import SlcanAdapter

_READ_SIZE = 4096


class SlcanPty:
    """A pseudo-terminal that leads to a serial CAN adapter.

    Parameters
    ----------
    adapter
        The adapter.
    link_path
        Symbolic link that always names the current terminal; None makes none. An existing symbolic
        link is replaced, anything else is an EndpointError.
    """

    def __init__(self, adapter: SlcanAdapter, link_path: Path | None = None) -> None:
        self._adapter = adapter
        self._link_path = link_path
        self._master_fd = -1
        self._slave_fd = -1
        self._terminal = ""
        self._polled_s: float | None = None
        self.plug_in()

    @property
    def channel(self) -> str:
        """Path that a client opens: the link, or the terminal itself without one."""
        return self._terminal if self._link_path is None else str(self._link_path)

    @property
    def plugged_in(self) -> bool:
        """Whether the terminal exists."""
        return self._master_fd >= 0

    def fileno(self) -> int:
        """Return the descriptor to wait on, SimulatorStateError while unplugged."""
        if not self.plugged_in:
            raise SimulatorStateError("the CAN adapter is unplugged and has no descriptor")
        return self._master_fd

    def poll(self, now_s: float) -> float:
        """Move bytes both ways without waiting; return when the next ones are due, in s."""
        if self.plugged_in:
            self._move(now_s)
        else:
            self._adapter.transmit(now_s)
            self._adapter.reset()
        return self._adapter.next_event_s()

    def unplug(self) -> None:
        """Take the terminal away; a client that has it open gets input/output errors."""
        self._adapter.reset()
        self.close()

    def plug_in(self) -> None:
        """Make a terminal, under a new name after `unplug`, and let the link name it."""
        if self.plugged_in:
            return
        try:
            # The own end of the client's side stays open: else the terminal fails between clients.
            self._master_fd, self._slave_fd = os.openpty()
            os.set_blocking(self._master_fd, False)
            tty.setraw(self._slave_fd)
            self._terminal = os.ttyname(self._slave_fd)
            self._make_link()
        except OSError as error:
            self.close()
            raise EndpointError(f"no terminal for the CAN adapter: {error}") from error

    def close(self) -> None:
        """Give terminal and link back; closing again changes nothing."""
        for descriptor in (self._master_fd, self._slave_fd):
            if descriptor >= 0:
                os.close(descriptor)
        self._master_fd = self._slave_fd = -1
        link = self._link_path
        if link is not None and link.is_symlink() and os.readlink(link) == self._terminal:
            link.unlink()

    def _move(self, now_s: float) -> None:
        try:
            data = os.read(self._master_fd, _READ_SIZE)
        except BlockingIOError:
            data = b""
        if data:
            self._adapter.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        output = self._adapter.transmit(now_s)
        if output:
            try:
                sent = os.write(self._master_fd, output)
            except BlockingIOError:
                sent = 0
            if sent < len(output):
                self._adapter.put_back(output[sent:])

    def _make_link(self) -> None:
        link = self._link_path
        if link is None:
            return
        if link.exists() and not link.is_symlink():
            raise FileExistsError(f"{link} exists and is not a symbolic link")
        fresh = link.with_name(f".{link.name}.{os.getpid()}")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self._terminal)
        fresh.replace(link)
