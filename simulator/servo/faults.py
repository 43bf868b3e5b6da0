"""Fault knobs of the line between host and servos; they are off by default.

They act on packets. The same seed and traffic always give the same result.
"""

import math
import random
from dataclasses import dataclass, field
from typing import NamedTuple

from simulator.errors import SimulatorSettingsError
from simulator.servo.protocol2 import crc16

_ROUNDING = 1e-6
"""Share of a period by which the time of a burst may be rounded."""


@dataclass(slots=True, kw_only=True)
class Trigger:
    """Choice of the packets for a fault; off by default."""

    probability: float = 0.0
    """Chance for each packet, 0 to 1."""
    every: int = 0
    """Applies to each n-th packet; 0: never."""
    next_packets: int = 0
    """Number of next packets with the fault; counts down to 0."""
    servo_ids: frozenset[int] | None = None
    """Only packets of these servos; None = all."""
    _seen: int = field(default=0, init=False, repr=False)

    def fires(self, servo_id: int, generator: random.Random) -> bool:
        """Return whether this packet gets the fault; SimulatorSettingsError for a bad setting."""
        if not 0.0 <= self.probability <= 1.0 or self.every < 0 or self.next_packets < 0:
            raise SimulatorSettingsError(f"a trigger has a setting out of range: {self}")
        if self.servo_ids is not None and servo_id not in self.servo_ids:
            return False
        if self.next_packets:
            self.next_packets -= 1
            return True
        self._seen += self.every > 0
        if self.every and self._seen % self.every == 0:
            return True
        return self.probability > 0.0 and generator.random() < self.probability


class Piece(NamedTuple):
    """Bytes on their way to the host."""

    delay_s: float
    """Additional delay in s."""
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Chatter:
    """Bytes that another device sends on the wire at any time."""

    data: bytes
    """Bytes of one burst."""
    every_s: float
    """Period of the bursts in s."""

    def moments_s(self, after_s: float, until_s: float) -> list[float]:
        """Return the times in s at which bursts begin, after one time and up to another one."""
        first, last = self._number(after_s) + 1, self._number(until_s)
        return [number * self.every_s for number in range(first, last + 1)]

    def next_s(self, after_s: float) -> float:
        """Return when the next burst begins in s."""
        return (self._number(after_s) + 1) * self.every_s

    def _number(self, time_s: float) -> int:
        return math.floor(time_s / self.every_s + _ROUNDING)


@dataclass(slots=True, kw_only=True)
class WireFaults:
    """Knobs of the wire between host and servos."""

    seed: int = 0
    """Seed of all random choices."""
    lose_request: Trigger = field(default_factory=Trigger)
    corrupt_request: Trigger = field(default_factory=Trigger)
    """A write of the host is lost; one bit of it flips."""
    drop: Trigger = field(default_factory=Trigger)
    delay: Trigger = field(default_factory=Trigger)
    duplicate: Trigger = field(default_factory=Trigger)
    bit_flip: Trigger = field(default_factory=Trigger)
    truncate: Trigger = field(default_factory=Trigger)
    garbage: Trigger = field(default_factory=Trigger)
    wrong_id: Trigger = field(default_factory=Trigger)
    """Faults of an answer. The other servos receive a dropped answer."""
    delay_s: float = 0.04
    """Delay of a delayed answer in s."""
    truncate_bytes: int = 3
    """Number of missing bytes at the end of a truncated answer."""
    garbage_data: bytes = b"\xaa\xff\xff\xfd\x55"
    """Bytes in front of an answer with the fault ``garbage``."""
    repeat_s: float = 0.0
    """Time in s after which each answer is repeated; 0: not repeated."""
    lag: bool = False
    """Each answer is replaced by the servo's previous answer of the same length."""
    chatter: Chatter | None = None
    """Bytes of another device, which damage an answer at the same time; None: no other device."""
    silent: set[int] = field(default_factory=set)
    """Servos that receive and answer nothing; later servos of a sync read stay silent too."""
    echo: bool = False
    """The host receives its own bytes back, as on a half-duplex adapter without switching."""
    fragment_bytes: int = 0
    fragment_gap_s: float = 0.002
    """Size of the pieces of answers in bytes (0: whole), and the pause between them in s."""
    unplugged: bool = False
    """The adapter is unplugged: no byte passes."""
    _generator: random.Random | None = field(default=None, init=False, repr=False)
    _before: dict[tuple[int, int], bytes] = field(default_factory=dict, init=False, repr=False)

    def request(self, data: bytes) -> bytes:
        """Return the bytes at the servos for one write of the host."""
        if self.lose_request.fires(-1, self._random()):
            return b""
        if self.corrupt_request.fires(-1, self._random()):
            return self._flip(data)
        return data

    def answer(self, servo_id: int, packet: bytes) -> list[Piece]:
        """Return the pieces of one answer at the host; without faults the unchanged packet."""
        generator = self._random()
        if self.lag:
            key = servo_id, len(packet)
            packet, self._before[key] = self._before.get(key, packet), packet
        if self.drop.fires(servo_id, generator):
            return []
        delay_s = self.delay_s if self.delay.fires(servo_id, generator) else 0.0
        if self.wrong_id.fires(servo_id, generator):
            body = packet[:4] + bytes(((packet[4] + 1) % 253,)) + packet[5:-2]
            packet = body + crc16(body).to_bytes(2, "little")
        if self.bit_flip.fires(servo_id, generator):
            packet = self._flip(packet)
        if self.truncate.fires(servo_id, generator):
            packet = packet[: max(0, len(packet) - self.truncate_bytes)]
        copies = 2 if self.duplicate.fires(servo_id, generator) else 1
        if self.garbage.fires(servo_id, generator):
            packet = self.garbage_data + packet
        pieces = self._fragments(delay_s, packet * copies)
        if self.repeat_s > 0.0:
            pieces += self._fragments(delay_s + self.repeat_s, packet)
        return pieces

    def _fragments(self, delay_s: float, packet: bytes) -> list[Piece]:
        size = self.fragment_bytes
        if size <= 0:
            return [Piece(delay_s, packet)]
        return [
            Piece(delay_s + i * self.fragment_gap_s, packet[start : start + size])
            for i, start in enumerate(range(0, len(packet), size))
        ]

    def _flip(self, data: bytes) -> bytes:
        if not data:
            return data
        bit = self._random().randrange(8 * len(data))
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        return bytes(flipped)

    def _random(self) -> random.Random:
        if self._generator is None:
            self._generator = random.Random(self.seed)
        return self._generator
