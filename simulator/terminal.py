"""A pseudo-terminal with a stable name: the plug of a simulated adapter."""

import os
import tty
from pathlib import Path

from simulator.errors import EndpointError, SimulatorStateError


class Terminal:
    """One pseudo-terminal; it may be taken away and come back under a new name.

    Parameters
    ----------
    what
        What it leads to, for messages.
    link_path
        Symbolic link that always names the current terminal; None makes none. An existing symbolic
        link is replaced, anything else is an EndpointError.
    """

    __slots__ = ("_link", "_name", "_what", "master_fd", "slave_fd")

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
    def exists(self) -> bool:
        """Whether the terminal is there."""
        return self.master_fd >= 0

    def fileno(self) -> int:
        """Return the descriptor to wait on, SimulatorStateError while there is none."""
        if not self.exists:
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
