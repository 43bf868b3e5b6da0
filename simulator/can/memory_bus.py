"""The host's end of a CAN bus in memory: one thread, virtual time."""

import math

import can

from simulator.can.link import CanLink
from simulator.clock import VirtualClock
from simulator.errors import SimulatorStateError


class InMemoryCanBus(can.BusABC):
    """The host's end of the bus, with the interface of python-can.

    Waiting in ``recv`` advances the clock. A message reaches the device before ``send`` returns.
    The time stamp of a message is the end of its transmission, in s of the clock.

    Parameters
    ----------
    link
        The bus and its devices.
    host_bitrate
        Bit rate of the host's adapter, by default that of the bus; with another one nothing passes.
    """

    def __init__(
        self, link: CanLink, clock: VirtualClock, *, host_bitrate: int | None = None
    ) -> None:
        self._deaf = host_bitrate not in (None, link.bitrate)
        self._link = link
        self.capture = self._link.capture
        """Hooks that are called with each message on the wire in order, also with lost ones."""
        self.faults = self._link.faults
        """Knobs of the link."""
        self.clock = clock
        self._lost = False
        clock.on_advance.append(self._link.advance)
        super().__init__(channel="simulated")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a message; it reaches the device before this returns.

        Raises can.CanOperationError if the adapter is unplugged, the controller is bus-off or the
        bus was shut down.
        """
        del timeout
        self._check_open()
        if self.faults.bus_off:
            raise can.CanOperationError("the CAN controller is bus-off: nothing was sent")
        if self._deaf:
            return
        if not msg.is_extended_id:  # no device here takes identifiers of 29 bits
            self._link.send(msg.arbitration_id, bytes(msg.data), self.clock.monotonic())

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next message, or None when none comes within ``timeout`` s.

        Waiting advances the clock, with None until a message comes. Raises can.CanOperationError if
        the adapter is unplugged or the bus was shut down. Raises SimulatorStateError for a wait
        without limit on a bus without any future message.
        """
        deadline_s = math.inf
        if timeout is not None:
            deadline_s = self.clock.monotonic() + max(timeout, 0.0)
        while not (messages := self.recv_all(1)):
            if self.clock.monotonic() >= deadline_s:
                return None
            next_s = min(self._link.next_event_s(), deadline_s)
            if math.isinf(next_s):
                raise SimulatorStateError(
                    "recv() without a time-out on a bus without any future message; give a time-out"
                )
            self.clock.advance_to(next_s)
        return messages[0]

    def recv_all(self, limit: int) -> list[can.Message]:
        """Return up to ``limit`` messages that have arrived; does not wait. Raises as `recv`."""
        self._check_open()
        messages = self._link.take(self.clock.monotonic(), limit)
        return [] if self._deaf else messages

    def shutdown(self) -> None:
        """Leave the bus; a second call changes nothing."""
        if not self._is_shutdown:
            self.clock.on_advance.remove(self._link.advance)
        super().shutdown()

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("the bus was shut down: open a new one")
        # As with the interfaces of the system: an open bus stays broken when the adapter is back.
        self._lost |= self._link.faults.unplugged
        if self._lost:
            raise can.CanOperationError("the CAN adapter is gone: plug it in and open it again")
