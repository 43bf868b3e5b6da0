"""A CAN bus in memory: the host and one control unit, one thread, virtual time."""

import bisect
import math
from collections import deque
from collections.abc import Callable
from typing import Protocol

import can
import numpy as np

from simulator.can_faults import CanLinkFaults, Disturber
from simulator.can_wire import CanWire
from simulator.clock import VirtualClock
from simulator.control_unit import SendBurst
from simulator.errors import SimulatorStateError

Capture = Callable[[float, int, bytes], None]
"""Takes time in s, identifier and data of each message that has gone over the wire."""

_ERROR_CONTROLLER, _ERROR_BUS_OFF = 0x04, 0x40
_CONTROLLER_PASSIVE = 0x30
_FLOOD_ID = 0x6FF


class CanDevice(Protocol):
    """What a bus asks of the device that is on it."""

    def connect(self, send: SendBurst) -> None:
        """Plug the device in."""
        ...

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take one message."""
        ...

    def advance(self, now_s: float) -> None:
        """Let the time pass."""
        ...

    def next_event_s(self) -> float:
        """Return when the device says something by itself next."""
        ...


class InMemoryCanBus(can.BusABC):
    """The host's end of the bus.

    Each message takes its time on the wire (`simulator.can_wire`), and waiting in ``recv`` moves
    the clock. What the host sends reaches the device at once and in order; only the time on the
    wire of what follows is moved by it. Messages carry the time at which they were through as
    their time stamp.

    Parameters
    ----------
    device
        The control unit.
    clock
        Whose time it is.
    bitrate
        Bits per second.
    faults
        Knobs that may be turned at any time.
    seed
        Seed of the faults that come by chance.

    Attributes
    ----------
    capture
        Called with each message that goes over the wire, lost ones included, in its order.
    faults
        The knobs.
    """

    def __init__(
        self,
        device: CanDevice,
        clock: VirtualClock,
        *,
        bitrate: int = 1_000_000,
        faults: CanLinkFaults | None = None,
        seed: int = 0,
    ) -> None:
        self.channel_info = f"simulated CAN bus at {bitrate} bit/s"
        self.capture: list[Capture] = []
        self.faults = faults or CanLinkFaults()
        self._device = device
        self._clock = clock
        self._wire = CanWire(bitrate)
        self._disturber = Disturber(self.faults, np.random.default_rng(seed))
        self._inbox: deque[can.Message] = deque()
        self._flood_due_s = math.inf
        self._reported = (False, False)
        device.connect(self._deliver)
        clock.on_advance.append(self._pass_time)
        super().__init__(channel="simulated")

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send a message; it reaches the device before this returns.

        Raises
        ------
        can.CanOperationError
            If the adapter is unplugged, the controller is bus-off or the bus was shut down.
        """
        del timeout
        self._check_open()
        if self.faults.bus_off:
            raise can.CanOperationError("the CAN controller is bus-off: nothing was sent")
        if msg.is_remote_frame or msg.is_error_frame or msg.is_fd:
            raise can.CanOperationError("the simulated bus carries classic data frames only")
        now_s = self._clock.monotonic()
        data = bytes(msg.data)
        through_s = self._wire.occupy(now_s, data, extended=msg.is_extended_id)
        for capture in self.capture:
            capture(through_s, msg.arbitration_id, data)
        if not msg.is_extended_id:
            self._device.receive(msg.arbitration_id, data, now_s)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """Return the next message, or None when none comes within ``timeout`` s.

        Waiting moves the clock; with None it moves until something comes.

        Raises
        ------
        can.CanOperationError
            If the adapter is unplugged or the bus was shut down.
        SimulatorStateError
            If it is told to wait without limit on a bus on which nothing will ever come.
        """
        clock, inbox = self._clock, self._inbox
        self._check_open()
        self._report_state()
        now_s = clock.monotonic()
        deadline_s = math.inf if timeout is None else now_s + max(timeout, 0.0)
        while True:
            while inbox and inbox[0].timestamp <= now_s:
                message = inbox.popleft()
                if self._filters is None or self._matches_filters(message):
                    return message
            if now_s >= deadline_s:
                return None
            next_s = min(self._device.next_event_s(), self._flood_due_s, deadline_s)
            if inbox:
                next_s = min(next_s, inbox[0].timestamp)
            if math.isinf(next_s):
                raise SimulatorStateError(
                    "recv() without a time-out on a bus on which nothing will ever come"
                )
            clock.advance_to(max(next_s, now_s))
            now_s = clock.monotonic()
            self._pass_time(now_s)
            self._check_open()
            self._report_state()

    def shutdown(self) -> None:
        """Leave the bus; a second call changes nothing."""
        if self._pass_time in self._clock.on_advance:
            self._clock.on_advance.remove(self._pass_time)
        super().shutdown()

    def _check_open(self) -> None:
        if self._is_shutdown:
            raise can.CanOperationError("the bus was shut down: open a new one")
        if self.faults.unplugged:
            raise can.CanOperationError("the CAN adapter is gone: plug it in and start again")

    def _pass_time(self, now_s: float) -> None:
        self._device.advance(now_s)
        if self.faults.flood_hz:
            self._flood(now_s)
        elif self._flood_due_s != math.inf:
            self._flood_due_s = math.inf

    def _deliver(self, ready_s: float, can_id: int, burst: list[bytes]) -> float:
        """Put the device's messages on the wire, one after the other, and into the inbox."""
        through_s = ready_s
        occupy, inbox = self._wire.occupy, self._inbox
        disturbs = self.faults.disturbs
        for data in burst:
            through_s = occupy(ready_s, data)
            for capture in self.capture:
                capture(through_s, can_id, data)
            if not disturbs:
                inbox.append(can.Message(through_s, can_id, False, data=data))
                continue
            for arrival_s, changed in self._disturber.pass_on(through_s, data):
                message = can.Message(arrival_s, can_id, False, dlc=len(data), data=changed)
                bisect.insort(inbox, message, key=_arrival_s)
        return through_s

    def _flood(self, now_s: float) -> None:
        self.faults.check()
        if math.isinf(self._flood_due_s):
            self._flood_due_s = now_s
        while self._flood_due_s <= now_s:
            data = self._disturber.rng.bytes(8)
            through_s = self._wire.occupy(self._flood_due_s, data)
            bisect.insort(
                self._inbox, can.Message(through_s, _FLOOD_ID, False, data=data), key=_arrival_s
            )
            self._flood_due_s += 1.0 / self.faults.flood_hz

    def _report_state(self) -> None:
        """Report a state of the controller once, as SocketCAN does: by an error frame."""
        passive, off = self.faults.error_passive, self.faults.bus_off
        if (passive, off) == self._reported:
            return
        before = self._reported
        self._reported = (passive, off)
        if passive and not before[0]:
            self._error_frame(_ERROR_CONTROLLER, _CONTROLLER_PASSIVE)
        if off and not before[1]:
            self._error_frame(_ERROR_BUS_OFF, 0)

    def _error_frame(self, error_class: int, controller: int) -> None:
        data = bytes((0, controller, 0, 0, 0, 0, 0, 0))
        message = can.Message(
            self._clock.monotonic(), error_class, False, is_error_frame=True, data=data
        )
        self._inbox.appendleft(message)


def _arrival_s(message: can.Message) -> float:
    return message.timestamp
