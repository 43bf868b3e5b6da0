"""Fault knobs of the line between host and servos; all off until they are turned.

They act on packets. A run with the same seed and the same traffic is always the same.
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
    """Choice of the packets that a fault hits; off as it is made."""

    probability: float = 0.0
    """Chance for each packet, 0 to 1."""
    every: int = 0
    """Hits each n-th packet; 0 = never."""
    next_packets: int = 0
    """Hits this many of the next packets, then goes off; counts down."""
    servo_ids: frozenset[int] | None = None
    """Only packets of these servos; None = all."""
    _seen: int = field(default=0, init=False, repr=False)

    @property
    def active(self) -> bool:
        """Whether any of the conditions is on."""
        return self.probability > 0.0 or self.every > 0 or self.next_packets > 0

    def fires(self, servo_id: int, generator: random.Random) -> bool:
        """Return whether the fault hits this packet; SimulatorSettingsError for a bad setting."""
        if not 0.0 <= self.probability <= 1.0 or self.every < 0 or self.next_packets < 0:
            raise SimulatorSettingsError(f"a trigger has a setting out of range: {self}")
        if self.servo_ids is not None and servo_id not in self.servo_ids:
            return False
        if self.next_packets:
            self.next_packets -= 1
            return True
        self._seen += 1
        if self.every and self._seen % self.every == 0:
            return True
        return self.probability > 0.0 and generator.random() < self.probability


class Piece(NamedTuple):
    """Bytes that leave for the host."""

    delay_s: float
    """How much later than without faults, s."""
    data: bytes


@dataclass(frozen=True, slots=True, kw_only=True)
class Chatter:
    """What another device sends on the wire, whoever speaks there."""

    data: bytes
    """Bytes of one burst."""
    every_s: float
    """Time from the begin of a burst to that of the next one, s."""

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
    """Seed of all chances."""
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
    """What happens to an answer. A dropped answer was heard by the other servos."""
    delay_s: float = 0.04
    """How late a delayed answer is, s."""
    truncate_bytes: int = 3
    """How many bytes a truncated answer lacks at its end."""
    garbage_data: bytes = b"\xaa\xff\xff\xfd\x55"
    """What comes in front of an answer hit by ``garbage``."""
    repeat_s: float = 0.0
    """Each answer comes again so much later, s; 0 = it does not."""
    lag: bool = False
    """Each answer is replaced by the servo's answer of the same length before it."""
    chatter: Chatter | None = None
    """What another device sends; an answer that it meets on the wire is damaged. None = nothing."""
    silent: set[int] = field(default_factory=set)
    """Servos that neither hear nor answer: later ones of a sync read stay silent too."""
    echo: bool = False
    """The host receives its own bytes back, as on a half-duplex adapter without switching."""
    fragment_bytes: int = 0
    fragment_gap_s: float = 0.002
    """Answers come in pieces of so many bytes with pauses between; 0 = whole."""
    unplugged: bool = False
    """The adapter is gone: nothing passes."""
    _generator: random.Random | None = field(default=None, init=False, repr=False)
    _before: dict[tuple[int, int], bytes] = field(default_factory=dict, init=False, repr=False)

    def request(self, data: bytes) -> bytes:
        """Return what the servos hear of the bytes that the host wrote in one go."""
        if self.lose_request.active and self.lose_request.fires(-1, self._random()):
            return b""
        if self.corrupt_request.active and self.corrupt_request.fires(-1, self._random()):
            return self._flip(data)
        return data

    def answer(self, servo_id: int, packet: bytes) -> list[Piece]:
        """Return what the host receives of one answer; in the usual case the packet as it is."""
        if not self._any_answer_fault():
            return [Piece(0.0, packet)]
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

    def _any_answer_fault(self) -> bool:
        triggers = (self.drop, self.delay, self.duplicate, self.bit_flip, self.truncate)
        return (
            self.lag
            or self.fragment_bytes > 0
            or self.repeat_s > 0.0
            or any(one.active for one in (*triggers, self.garbage, self.wrong_id))
        )

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
