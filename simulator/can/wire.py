"""The CAN wire: the time that a message occupies it."""

import math
from collections import deque
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from simulator.errors import SimulatorSettingsError

_CRC_POLYNOMIAL = 0x4599
"""Polynomial of the CRC-15 (ISO 11898-1)."""
_STUFFABLE_BITS = 34
"""Start of frame, identifier, control field and CRC of an 11-bit data frame, in bits."""
_FIXED_BITS = 13
"""Delimiters, acknowledge, end of frame and interframe space, in bits."""
_EXTENDED_BITS = 20
"""Bits that an identifier of 29 bits adds: 18 of its own, SRR and r1."""
_STUFF_PER_BIT = 2.8 / (_STUFFABLE_BITS + 64)
"""Stuff bits per bit of random content: 2.8 in a message of 8 bytes (mean of `exact_bits`)."""
_STUFF_PER_QUIET_BYTE = 9.1 / 7
"""Stuff bits that a byte of 0x00 or 0xFF adds: 9.1 in a message with 7 of them (as above)."""


def crc15(bits: Sequence[int]) -> int:
    """Return the CRC-15 of a CAN frame over bits, the first one sent first (ISO 11898-1)."""
    crc = 0
    for bit in bits:
        crc = (crc << 1 & 0x7FFF) ^ (_CRC_POLYNOMIAL if bit ^ (crc >> 14) else 0)
    return crc


def stuff(bits: Sequence[int]) -> list[int]:
    """Return bits with the complement put in after each five equal ones."""
    stuffed: list[int] = []
    run, last = 0, -1
    for bit in bits:
        stuffed.append(bit)
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            last = 1 - bit
            run = 1
            stuffed.append(last)
    return stuffed


def exact_bits(can_id: int, data: bytes) -> int:
    """Return the bits of a classic 11-bit data frame with its stuff bits and interframe space."""
    bits = [0]  # start of frame
    bits += [can_id >> i & 1 for i in range(10, -1, -1)]
    bits += [0, 0, 0]  # RTR, IDE, r0
    bits += [len(data) >> i & 1 for i in range(3, -1, -1)]
    bits += [byte >> i & 1 for byte in data for i in range(7, -1, -1)]
    crc = crc15(bits)
    bits += [crc >> i & 1 for i in range(14, -1, -1)]
    return len(stuff(bits)) + _FIXED_BITS


def mean_bits(data: bytes, *, extended: bool = False) -> float:
    """Return the bits that a data frame of this content takes in the mean.

    Stuffing is counted as for random bits (113.8 bits for 8 bytes), plus what bytes of 0x00 and
    0xFF cost: an untouched skin loads the bus more than a touched one (122.9 bits for a header and
    7 such bytes). Within 3 % of the mean of `exact_bits` over many messages, at a fiftieth of its
    cost.
    """
    length = _STUFFABLE_BITS + 8 * len(data)
    quiet = data.count(0) + data.count(255)
    return (
        length
        + _FIXED_BITS
        + _STUFF_PER_BIT * length
        + _STUFF_PER_QUIET_BYTE * quiet
        + (_EXTENDED_BITS if extended else 0)
    )


class Waiting(NamedTuple):
    """A message that waits for the wire.

    Attributes
    ----------
    ready_s
        Time in s from which on its controller offers it.
    can_id, data, extended
        Identifier, content, and whether the identifier has 29 bits.
    sender
        Whatever the caller wants to have back with it.
    """

    ready_s: float
    can_id: int
    data: bytes
    extended: bool
    sender: object


class CanWire:
    """One wire that carries one message at a time; the lowest identifier that waits goes first.

    Messages of one identifier keep their order, as in a controller with one mailbox for each.

    Parameters
    ----------
    bitrate
        Bits per second.

    Attributes
    ----------
    n_waiting
        Number of messages that wait.
    """

    __slots__ = (
        "_bit_s",
        "_busy_until_s",
        "_next",
        "_queues",
        "bitrate",
        "n_waiting",
    )

    def __init__(self, bitrate: int) -> None:
        if bitrate <= 0:
            raise SimulatorSettingsError(f"CAN bit rate is {bitrate} bit/s, must be positive")
        self.bitrate = bitrate
        self._bit_s = 1.0 / bitrate
        self._busy_until_s = -math.inf
        self._queues: dict[float, deque[tuple[Waiting, float]]] = {}
        self.n_waiting = 0
        self._next: tuple[float, float] | None = None
        """End of the next message in s, and its queue; None until it is worked out."""

    def put(self, message: Waiting, *, first: bool = False) -> None:
        """Let a message wait from its ``ready_s`` on; ``first`` before all others."""
        # A 29 bit identifier loses against 11 equal bits (ISO 11898-1, arbitration).
        key = (message.can_id >> 18) + 0.5 if message.extended else float(message.can_id)
        length_s = mean_bits(message.data, extended=message.extended) * self._bit_s
        self._queues.setdefault(-1.0 if first else key, deque()).append((message, length_s))
        self.n_waiting += 1
        self._next = None

    def next_end_s(self) -> float:
        """Return when the next message will be through, in s; infinity where none waits."""
        if not self._queues:
            return math.inf
        if self._next is None:
            heads = [(key, *queue[0]) for key, queue in self._queues.items()]
            start_s = max(self._busy_until_s, min(head[1].ready_s for head in heads))
            key, _, length_s = min(head for head in heads if head[1].ready_s <= start_s)
            self._next = start_s + length_s, key
        return self._next[0]

    def take(self, now_s: float) -> Iterator[tuple[float, Waiting]]:
        """Yield the messages that are through until ``now_s`` s, with the end of each in s."""
        while (end_s := self.next_end_s()) <= now_s and self._next is not None:
            key = self._next[1]
            queue = self._queues[key]
            message, _ = queue.popleft()
            self.n_waiting -= 1
            if not queue:
                del self._queues[key]
            self._busy_until_s, self._next = end_s, None
            yield end_s, message

    def end_s(self, ready_s: float, can_id: int) -> float:
        """Return when the last message of an 11 bit identifier will be through, in s.

        So it is if no other one that goes before it joins those that wait; ``ready_s`` at least.
        """
        before_s = sum(
            length_s
            for key, queue in self._queues.items()
            if key <= can_id
            for _, length_s in queue
        )
        return max(self._busy_until_s, ready_s) + before_s
