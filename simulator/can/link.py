"""The link between the control unit and the host's CAN adapter: wire time, faults, capture.

`simulator.can.memory_bus` adds python-can's interface, `simulator.can.slcan` the serial one.
"""

import bisect
import math
from collections import deque
from collections.abc import Callable, Iterable
from operator import attrgetter
from typing import Protocol

import can
import numpy as np

from simulator.can.faults import CanLinkFaults
from simulator.can.node import SendBurst
from simulator.can.wire import CanWire

Capture = Callable[[float, int, bytes], None]
"""Takes time in s, identifier and data of each message on the wire."""

_ERROR_CONTROLLER, _ERROR_BUS_OFF = 0x04, 0x40
"""Classes of error frames in the identifier, as in SocketCAN (linux/can/error.h)."""
_CONTROLLER_PASSIVE, _CONTROLLER_ACTIVE = 0x30, 0x40
"""States of the controller in data byte 1 of an error frame."""
_ARRIVAL_S = attrgetter("timestamp")
"""Time in s at which a message arrives."""
_FLOOD_ID = 0x6FF
"""Identifier of flooding messages: an SDO request to the unused node 127."""
_INBOX_LIMIT = 100_000
"""Most messages in the adapter's memory: half a minute of frames at 50 Hz."""


class CanDevice(Protocol):
    """A device on a bus."""

    send: SendBurst
    """Sends its messages; set when it is plugged in."""

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        """Take one message."""

    def advance(self, now_s: float) -> None:
        """Let the time pass."""

    def next_event_s(self) -> float:
        """Return when the device next sends something by itself, in s."""


class CanLink:
    """Devices, one wire, and the host's adapter.

    Messages of the host reach the devices at once and in order, so they go first on the wire.
    Messages of a device arrive with their last bit.
    """

    def __init__(
        self,
        *devices: CanDevice,
        bitrate: int = 1_000_000,
        faults: CanLinkFaults | None = None,
        seed: int = 0,
    ) -> None:
        self.capture: list[Capture] = []
        """Called with each message on the wire in order, also with lost messages."""
        self.faults = faults or CanLinkFaults()
        self.bitrate = bitrate
        """Bit rate in bit/s; a host with another one has no communication."""
        self._devices = list(devices)
        self._wire = CanWire(bitrate)
        self._rng = np.random.default_rng(seed)
        self._inbox: deque[can.Message] = deque()
        self._flood_due_s = math.inf
        self._reported = (False, False)
        for device in devices:
            device.send = self._deliver

    def add(self, device: CanDevice) -> Callable[[], None]:
        """Plug in a further device; returns the function that removes it from the bus."""
        device.send = self._deliver
        self._devices.append(device)
        return lambda: self._devices.remove(device)

    def send(self, can_id: int, data: bytes, now_s: float) -> None:
        """Send a message of the host; it reaches the devices before this returns."""
        self._wire.put(now_s, can_id, (data,), from_host=True)
        if not self.faults.bus_off:
            for device in tuple(self._devices):
                device.receive(can_id, data, now_s)

    def take(self, now_s: float, limit: int = _INBOX_LIMIT) -> list[can.Message]:
        """Let the time pass until ``now_s`` s; return up to ``limit`` arrived messages."""
        self.advance(now_s)
        arrived = min(limit, bisect.bisect_right(self._inbox, now_s, key=_ARRIVAL_S))
        return [self._inbox.popleft() for _ in range(arrived)]

    def advance(self, now_s: float) -> None:
        """Let devices and faults act until ``now_s`` s."""
        faults = self.faults
        for device in self._devices:
            device.advance(now_s)
        if faults.flood_hz:
            self._flood(now_s)
        elif self._flood_due_s != math.inf:
            self._flood_due_s = math.inf
        if (faults.error_passive, faults.bus_off) != self._reported:
            self._report_state(now_s)
        if self._wire.next_end_s() <= now_s:
            self._transmit(now_s)

    def next_event_s(self) -> float:
        """Return the time of the next arrival or own message of a device; infinity: never."""
        next_s = min(device.next_event_s() for device in self._devices)
        next_s = min(next_s, self._flood_due_s, self._wire.next_end_s())
        return min(next_s, self._inbox[0].timestamp) if self._inbox else next_s

    def clear(self, now_s: float = math.inf) -> None:
        """Drop messages that arrived until ``now_s`` s, as by closing the adapter."""
        self._transmit(now_s)
        self._inbox.clear()
        self._reported = (False, False)

    def _deliver(self, ready_s: float, can_id: int, burst: list[bytes]) -> float:
        """Queue the device's messages for the wire; returns the end time of the last one in s.

        Later messages with a higher priority may still delay it. With a full memory they are lost.
        """
        if len(self._inbox) + self._wire.n_waiting > _INBOX_LIMIT:
            return ready_s
        self._wire.put(ready_s, can_id, burst)
        return self._wire.end_s(ready_s, can_id)

    def _transmit(self, now_s: float) -> None:
        """Move messages sent until ``now_s`` s into the inbox, with the faults."""
        inbox, faults = self._inbox, self.faults
        disturbs = faults.disturbs
        for end_s, can_id, data, from_host in self._wire.take(now_s):
            for capture in self.capture:
                capture(end_s, can_id, data)
                # It may have injected a fault.
                disturbs = faults.disturbs
            if from_host:
                continue
            arrivals: Iterable[tuple[float, int, bytes]] = ((end_s, len(data), data),)
            if disturbs:
                arrivals = faults.pass_on(end_s, data, self._rng)
            for arrival_s, length_code, changed in arrivals:
                message = can.Message(arrival_s, can_id, False, dlc=length_code, data=changed)
                if inbox and inbox[-1].timestamp > arrival_s:
                    bisect.insort(inbox, message, key=_ARRIVAL_S)
                else:
                    inbox.append(message)

    def _flood(self, now_s: float) -> None:
        if math.isinf(self._flood_due_s):
            self._flood_due_s = now_s
        while self._flood_due_s <= now_s:
            self._wire.put(self._flood_due_s, _FLOOD_ID, (self._rng.bytes(8),))
            self._flood_due_s += 1.0 / self.faults.flood_hz

    def _report_state(self, now_s: float) -> None:
        """Report a state of the controller once, as SocketCAN does: by an error frame."""
        passive, off = self.faults.error_passive, self.faults.bus_off
        if passive != self._reported[0]:
            state = _CONTROLLER_PASSIVE if passive else _CONTROLLER_ACTIVE
            self._error_frame(now_s, _ERROR_CONTROLLER, state)
        if off and not self._reported[1]:
            self._error_frame(now_s, _ERROR_BUS_OFF, 0)
        self._reported = (passive, off)

    def _error_frame(self, now_s: float, error_class: int, controller: int) -> None:
        data = bytes((0, controller, 0, 0, 0, 0, 0, 0))
        self._inbox.appendleft(
            can.Message(now_s, error_class, False, is_error_frame=True, data=data)
        )
