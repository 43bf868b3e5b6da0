"""The control unit's codec: frames and force messages that it sends, objects that it receives.

Pure functions, written from docs/reference/control-unit.md and separate from the driver's codec: an
error in one of them shows as a disagreement.
"""

import struct
from binascii import crc_hqx
from dataclasses import dataclass
from functools import cache
from math import ceil

import numpy as np
from numpy.typing import NDArray

from tactile.source import ForceMessage

MESSAGE_BYTES = 8
FORCE_COUNTERS = 16
"""Number of different counters of force messages."""
TABLE_NODES = 129
"""Forces in the table of one pad, at even steps from 0 counts to full scale."""

_TRAILER_BYTES = 5
"""Counter, status and CRC at the end of a burst."""
_SHORT_BURST = 64
"""Most messages of a burst with one-byte headers: six bits for the number."""
_TABLE_STEP_N = 0.0005
_ZERO_STEPS = 60_000
"""Steps of a zero in the full scale of the counts."""
_FAILING = 0xFFFF
"""Zero of a failing taxel."""
_FORCE_STEPS_N, _CENTRE_STEPS_TAXELS = 500, 16
"""Steps of a force in 1 N, and of a centre in one pitch of the taxels."""
_NOWHERE = -128
"""Centre of a zero force."""


class DamagedObject(ValueError):
    """An object that the host wrote has a wrong length or a wrong CRC."""


@dataclass(frozen=True, slots=True)
class BurstFormat:
    """The division of a scan into the messages of one burst, as in object 2101h."""

    n_taxels: int
    sample_bytes: int

    @property
    def header_bytes(self) -> int:
        """One if six bits are enough for the number of messages, else two."""
        return 1 if self._content_bytes <= _SHORT_BURST * (MESSAGE_BYTES - 1) else 2

    @property
    def n_messages(self) -> int:
        """Messages of one burst."""
        return ceil(self._content_bytes / (MESSAGE_BYTES - self.header_bytes))

    @property
    def _content_bytes(self) -> int:
        return self.n_taxels * self.sample_bytes + _TRAILER_BYTES

    def samples(self, counts: NDArray[np.uint16]) -> bytes:
        """Return the samples of a scan, as the burst has them."""
        return counts.astype("<u1" if self.sample_bytes == 1 else "<u2").tobytes()

    def burst(self, counts: NDArray[np.uint16], counter: int, status: int) -> list[bytes]:
        """Return the messages of a scan with counts (n_taxels,), in the order of sending."""
        samples = self.samples(counts)
        header_bytes, n_messages = self.header_bytes, self.n_messages
        size = MESSAGE_BYTES - header_bytes
        filling = bytes(n_messages * size - len(samples) - _TRAILER_BYTES)
        checked = samples + filling + struct.pack("<HB", counter, status)
        data = checked + struct.pack("<H", crc_hqx(checked, 0xFFFF))
        heads = _heads(header_bytes, n_messages, counter % 4)
        return [head + data[n * size : (n + 1) * size] for n, head in enumerate(heads)]


@cache
def _heads(header_bytes: int, n_messages: int, phase: int) -> tuple[bytes, ...]:
    """Return the heads of the messages of a burst: its phase, and the number of each."""
    first = phase << 8 * header_bytes - 2
    return tuple((first | n).to_bytes(header_bytes, "big") for n in range(n_messages))


def force_bytes(message: ForceMessage) -> bytes:
    """Return a force message; values are limited to their range."""
    along, across = (
        (_NOWHERE, _NOWHERE)
        if message.centre_taxels is None
        else (_within(127, place * _CENTRE_STEPS_TAXELS) for place in message.centre_taxels)
    )
    first, second = (_within(32767, force_n * _FORCE_STEPS_N) for force_n in message.force_n)
    head = message.status << 4 | message.counter
    checked = struct.pack("<B2h2b", head, first, second, along, across)
    return checked + bytes((_crc8(checked),))


def read_table(data: bytes) -> NDArray[np.float64]:
    """Return the forces in N of object 2141h, (2, `TABLE_NODES`). DamagedObject for another."""
    return _numbers(data, 2 * TABLE_NODES).reshape(2, TABLE_NODES) * _TABLE_STEP_N


def read_zero(
    data: bytes, n_taxels: int, adc_max: int
) -> tuple[float, NDArray[np.float64], NDArray[np.bool_]]:
    """Return threshold, zeros (n,) in counts and failing taxels (n,) of object 2142h.

    DamagedObject for another.
    """
    steps = _numbers(data, 1 + n_taxels)
    counts = steps * (adc_max / _ZERO_STEPS)
    return float(counts[0]), counts[1:], steps[1:] == _FAILING


def _numbers(data: bytes, n: int) -> NDArray[np.float64]:
    # The CRC of this kind over data with their CRC, high byte first, is zero.
    if len(data) != 2 * n + 2 or crc_hqx(data[:-2] + data[:-3:-1], 0xFFFF):
        raise DamagedObject(f"{len(data)} bytes where {2 * n + 2} were expected, or a wrong CRC")
    return np.frombuffer(data, "<u2", n).astype(np.float64)


def _within(limit: int, steps: float) -> int:
    return min(max(round(steps), -limit), limit)


def _crc8(data: bytes) -> int:
    """Return the CRC-8 of SAE J1850: polynomial 1Dh, start and final inversion FFh."""
    remainder = 0xFF
    for byte in data:
        remainder = _CRC8_OF[remainder ^ byte]
    return remainder ^ 0xFF


def _divided(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (0x11D if byte & 0x80 else 0)
    return byte


_CRC8_OF = bytes(map(_divided, range(256)))
