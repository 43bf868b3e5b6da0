"""The serial CAN adapter as a pseudo-terminal, for clients in other processes.

It has no loop of its own: whoever owns it waits until its descriptor is readable or its next event
is due, and calls `SlcanPty.poll`.
"""

from pathlib import Path

from simulator.slcan import SlcanAdapter
from simulator.terminal import Terminal

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
        self._terminal = Terminal("the CAN adapter", link_path)
        self._polled_s: float | None = None
        self.plug_in()

    @property
    def channel(self) -> str:
        """Path that a client opens: the link, or the terminal itself without one."""
        return self._terminal.path

    @property
    def plugged_in(self) -> bool:
        """Whether the terminal exists."""
        return self._terminal.exists

    def fileno(self) -> int:
        """Return the descriptor to wait on, SimulatorStateError while unplugged."""
        return self._terminal.fileno()

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
        if not self.plugged_in:
            self._terminal.open()

    def close(self) -> None:
        """Give terminal and link back; closing again changes nothing."""
        self._terminal.close()

    def _move(self, now_s: float) -> None:
        data = self._terminal.read(_READ_SIZE)
        if data:
            self._adapter.receive(data, now_s, sent_after_s=self._polled_s)
        self._polled_s = now_s
        output = self._adapter.transmit(now_s)
        if output:
            sent = self._terminal.write(output)
            if sent < len(output):
                self._adapter.put_back(output[sent:])
