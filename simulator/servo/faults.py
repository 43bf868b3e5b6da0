"""Fault knobs of the line between host and servos; they are off by default.

They act on packets. The same seed and traffic always give the same result.
"""

import random
from dataclasses import dataclass, field

from simulator.knobs import SHARE, Number, knob
from simulator.servo.protocol2 import crc16


@dataclass(frozen=True, slots=True, kw_only=True)
class Chatter:
    """Bytes that another device sends on the wire at any time."""

    data: bytes
    """Bytes of one burst."""
    every_s: float
    """Period of the bursts in s."""


_GARBAGE = b"\xaa\xff\xff\xfd\x55"
"""Bytes in front of an answer with the fault ``garbage``."""
_TRUNCATED_BYTES = 3
"""Number of missing bytes at the end of a truncated answer."""


@dataclass(slots=True, kw_only=True)
class WireFaults:
    """Knobs of the wire between host and servos."""

    rng: random.Random = field(default_factory=lambda: random.Random(0), repr=False)
    """Source of all random choices."""
    lose_request: float = knob("servos.lost_requests", "requests are lost", SHARE)
    drop: float = knob("servos.loss", "answers are lost", SHARE)
    """The other servos receive a lost answer."""
    bit_flip: float = knob("servos.corrupt", "one bit of an answer flips", SHARE)
    truncate: float = knob("servos.truncated", "answers lack their end", SHARE)
    garbage: float = knob("servos.garbage", "noise comes before an answer", SHARE)
    wrong_id: float = knob("servos.wrong_id", "answers name another servo", SHARE)
    drop_next: int = 0
    """Number of next answers that are lost."""
    delay_s: float = knob(
        "servos.delayed", "all answers come late", Number("s", 0.0, 1.0, default=0.04)
    )
    repeat_s: float = knob(
        "servos.repeated",
        "each answer comes again after this time",
        Number("s", 1e-4, 1.0, default=0.0095),
    )
    lag: bool = knob("servos.lagging", "each answer is that to the previous request of its kind")
    """It is replaced by the servo's previous answer of the same length."""
    chatter: Chatter | None = None
    """Bytes of another device, which damage an answer at the same time; None: no other device."""
    silent: set[int] = field(default_factory=set)
    """Servos that receive and answer nothing; later servos of a sync read stay silent too."""
    echo: bool = knob("servos.echo", "the host receives its own bytes")
    """As on a half-duplex adapter without switching."""
    unplugged: bool = knob("servos.unplugged", "the adapter of the servo bus is gone")
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
            bit = self.rng.randrange(8 * len(packet))
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
        return self.rng.random() < share
