"""Fault knobs of the line between host and servos; they are off by default.

They act on packets. The same seed and traffic always give the same result.
"""

import math
import random
from dataclasses import dataclass, field

from simulator.servo.protocol2 import crc16

_ROUNDING = 1e-6
"""Share of a period by which the time of a burst may be rounded."""


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


_GARBAGE = b"\xaa\xff\xff\xfd\x55"
"""Bytes in front of an answer with the fault ``garbage``."""
_TRUNCATED_BYTES = 3
"""Number of missing bytes at the end of a truncated answer."""


@dataclass(slots=True, kw_only=True)
class WireFaults:
    """Knobs of the wire between host and servos."""

    seed: int = 0
    """Seed of all random choices."""
    lose_request: float = 0.0
    """Share from 0 to 1 of the host's writes that are lost."""
    drop: float = 0.0
    bit_flip: float = 0.0
    truncate: float = 0.0
    garbage: float = 0.0
    wrong_id: float = 0.0
    """Share from 0 to 1 of the answers that are lost, have one bit flipped, lack their end, come
    after other bytes, or name another servo. The other servos receive a lost answer."""
    drop_next: int = 0
    """Number of next answers that are lost."""
    delay_s: float = 0.0
    """Delay of answers in s."""
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
    unplugged: bool = False
    """The adapter is unplugged: no byte passes."""
    _generator: random.Random | None = field(default=None, init=False, repr=False)
    _before: dict[tuple[int, int], bytes] = field(default_factory=dict, init=False, repr=False)

    def request(self, data: bytes) -> bytes:
        """Return the bytes at the servos for one write of the host."""
        return b"" if self.lose_request and self._happens(self.lose_request) else data

    def answer(self, servo_id: int, packet: bytes) -> list[tuple[float, bytes]]:
        """Return additional delay in s and bytes of the pieces of one answer at the host."""
        if self.lag:
            key = servo_id, len(packet)
            packet, self._before[key] = self._before.get(key, packet), packet
        if self.drop_next:
            self.drop_next -= 1
            return []
        if self.drop and self._happens(self.drop):
            return []
        if self.wrong_id and self._happens(self.wrong_id):
            body = packet[:4] + bytes(((packet[4] + 1) % 253,)) + packet[5:-2]
            packet = body + crc16(body).to_bytes(2, "little")
        if self.bit_flip and self._happens(self.bit_flip):
            bit = self._random().randrange(8 * len(packet))
            flipped = bytearray(packet)
            flipped[bit // 8] ^= 1 << bit % 8
            packet = bytes(flipped)
        if self.truncate and self._happens(self.truncate):
            packet = packet[:-_TRUNCATED_BYTES]
        if self.garbage and self._happens(self.garbage):
            packet = _GARBAGE + packet
        pieces = [(self.delay_s, packet)]
        if self.repeat_s > 0.0:
            pieces.append((self.delay_s + self.repeat_s, packet))
        return pieces

    def _happens(self, share: float) -> bool:
        return self._random().random() < share

    def _random(self) -> random.Random:
        if self._generator is None:
            self._generator = random.Random(self.seed)
        return self._generator
