"""The CAN link between the control unit and the host's adapter: wire time, faults, capture.

The host's end is python-can's interface in memory, in one thread and in virtual time;
`simulator.can.slcan` has the serial one.
"""

import bisect
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from operator import attrgetter
from typing import NamedTuple, Protocol

import can
import numpy as np

from simulator.can.faults import CanLinkFaults
from simulator.can.node import SendBurst
from simulator.clock import VirtualClock
from simulator.errors import SimulatorStateError

_STUFFABLE_BITS = 34
"""Start of frame, identifier, control field and CRC of an 11-bit data frame, in bits."""
_FIXED_BITS = 13
"""Delimiters, acknowledge, end of frame and interframe space, in bits."""
_STUFF_PER_BIT = 2.8 / (_STUFFABLE_BITS + 64)
"""Stuff bits per bit of random content: 2.8 in a message of 8 bytes (mean of the exact count)."""
_STUFF_PER_QUIET_BYTE = 9.1 / 7
"""Stuff bits of a byte of 0x00 or 0xFF: 9.1 in a message with 7 of them (as above)."""
_HOST = -1
"""Priority of the host's messages, which go before all others."""
_OUTBOX_LIMIT = 100
"""Most messages that wait in the adapter of the host."""


def mean_bits(*burst: bytes) -> float:
    """Return the mean number of bits of data frames with these contents, one or more.

    Stuffing is counted as for random bits (113.8 bits for 8 bytes), plus that of bytes 0x00 and
    0xFF. So untouched pads load the bus more than touched ones (122.9 bits for a header and 7 bytes
    of 0x00). The result is within 3 % of the mean of the exact count (ISO 11898-1), at a fiftieth
    of its computing time.
    """
    content = b"".join(burst)
    length = _STUFFABLE_BITS + 8 * len(content) / len(burst)
    quiet_bytes = (content.count(0x00) + content.count(0xFF)) / len(burst)
    return length + _FIXED_BITS + _STUFF_PER_BIT * length + _STUFF_PER_QUIET_BYTE * quiet_bytes


class _Burst(NamedTuple):
    """Messages of one identifier that wait, or are on the wire."""

    ready_s: float
    """Time in s at which they are ready to send."""
    message_s: float
    """Time in s that each of them takes."""
    can_id: int
    waiting: deque[bytes]
    """Their data."""


class CanWire:
    """One wire that carries one message at a time; the lowest identifier that waits goes first.

    Messages of one identifier keep their order, as in a controller with one mailbox for each.
    """

    def __init__(self, bitrate: int) -> None:
        self._bit_s = 1.0 / bitrate
        self._free_s = -math.inf
        self._queues: dict[int, deque[_Burst]] = {}
        """What waits, by its priority: the identifier, or that of the host."""

    @property
    def n_waiting(self) -> int:
        """Number of messages that wait."""
        return sum(len(burst.waiting) for queue in self._queues.values() for burst in queue)

    @property
    def host_is_full(self) -> bool:
        """Whether as many messages of the host wait as its adapter holds."""
        return len(self._queues.get(_HOST, ())) >= _OUTBOX_LIMIT

    def put(
        self, ready_s: float, can_id: int, burst: Sequence[bytes], *, from_host: bool = False
    ) -> None:
        """Let messages of one identifier wait from ``ready_s`` on; the host's go before all others.

        Each of them takes the mean time of all.
        """
        key = _HOST if from_host else can_id
        message_s = mean_bits(*burst) * self._bit_s
        queue = self._queues.setdefault(key, deque())
        queue.append(_Burst(ready_s, message_s, can_id, deque(burst)))

    def next_end_s(self) -> float:
        """Return when the next message will be through, in s; infinity if none waits."""
        return self._next()[0] if self._queues else math.inf

    def _next(self) -> tuple[float, int]:
        """Return when the next message will be through, in s, and its queue."""
        key, *others = self._queues
        start_s = max(self._free_s, self._queues[key][0].ready_s)
        if others:
            ready_s = [(queue[0].ready_s, key) for key, queue in self._queues.items()]
            start_s = max(self._free_s, min(ready_s)[0])
            key = min(key for at_s, key in ready_s if at_s <= start_s)
        return start_s + self._queues[key][0].message_s, key

    def take(self, now_s: float) -> Iterator[tuple[float, int, bytes, bool]]:
        """Yield what is through until ``now_s`` s.

        For each message: its end in s, identifier, data, and whether it is the host's.
        """
        while self._queues:
            end_s, key = self._next()
            if end_s > now_s:
                return
            self._free_s = end_s
            queue = self._queues[key]
            burst = queue[0]
            data = burst.waiting.popleft()
            if not burst.waiting:
                queue.popleft()
            if not queue:
                del self._queues[key]
            yield end_s, burst.can_id, data, key == _HOST

    def end_s(self, ready_s: float, can_id: int) -> float:
        """Return when the last message of an identifier will be through, in s.

        So it is if no other one that goes before it joins those that wait; ``ready_s`` at least.
        """
        busy_s = 0.0
        for key, queue in self._queues.items():
            if key <= can_id:
                busy_s += sum([len(burst.waiting) * burst.message_s for burst in queue])
        return max(self._free_s, ready_s) + busy_s


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
_HIGHEST_ID = 0x7FF
"""Largest identifier of 11 bits: it goes last."""
_FLOOD_S = 0.02
"""Longest wait in s of a flooding message: a full controller sends nothing more."""
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
        """Send a message of the host; it reaches the devices before this returns.

        Raises can.CanOperationError if the adapter is full.
        """
        if self._wire.host_is_full:
            raise can.CanOperationError("the transmit buffer of the adapter is full")
        # After a stall of its owner, earlier messages must not count as those that still wait.
        self._transmit(now_s)
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

    def free_s(self, now_s: float) -> float:
        """Return when all that waits now will be through, in s."""
        return self._wire.end_s(now_s, _HIGHEST_ID)

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
            if self._wire.end_s(self._flood_due_s, _FLOOD_ID) < now_s + _FLOOD_S:
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
        # No device here takes identifiers of 29 bits, remote frames or CAN FD.
        if not (msg.is_extended_id or msg.is_remote_frame or msg.is_fd):
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
