"""Messages of the control unit: the bursts of a frame, and the force messages. Pure.

Frames
------
One frame of samples is sent in one burst of 8-byte messages. A message is a header and data. The
header has the frame's phase (counter modulo 4) in the two top bits, then the message's index in the
burst. It has one byte for up to 64 messages, else two (high byte first). The data of all messages
of a burst in order are the samples (u8 or u16 little-endian), zero bytes up to the trailer, and the
trailer at the end of the last message. The trailer is the frame counter u16 LE, status u8, and
CRC-16/CCITT-FALSE u16 LE over all data before it.

Forces
------
A force message has the force on both gripping pads in 8 bytes, many times a second. Byte 0 has the
counter in the low nibble, the status in the high one. Then follow the force on finger 0 and finger
1 (i16 little-endian, 2 mN). The next two bytes are the centre of force of both pads together, along
and across the fingers (i8). Its unit is 1/16 of the taxels' pitch, from the middle of the pads. The
last byte is the CRC-8 of SAE J1850 over the 7 bytes before it. This is similar to AUTOSAR's E2E
profile 1, with a counter of 4 bits and a CRC of 8.

The host writes two objects for the sum of the force, each with a CRC-16 at its end. They are the
table of counts to force and the zero of each taxel. Equation (11) is not linear in counts, so the
sum of counts is not a force. All numbers of both are u16 little-endian.
"""

import binascii
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile.errors import FrameError, LayoutError
from tactile.layout import TaxelLayout
from tactile.source import COUNTER_MASK, ForceMessage, FrameStatistics, ScanStatus, TactileFrame

MESSAGE_BYTES = 8
"""Data bytes of every message: all that a classic CAN message has."""
_TRAILER = struct.Struct("<HBH")
"""End of the last message: frame counter, status, CRC."""
CRC_BYTES = 2
CRC_START = 0xFFFF
"""Start value of CRC-16/CCITT-FALSE."""
_PHASES = 4
"""Number of phases, the counter's two lowest bits."""
PHASE_SHIFT = 6
"""The phase is in the two top bits of the first header byte."""
_INDEX_BITS = 0x3F
"""Bits of the message's index, or of its high byte, in the first header byte."""
_HALF_TURN = 0x8000
"""Least difference to the last counter of a counter that is older, not newer."""
_SHORT_INDEX_LIMIT = _INDEX_BITS + 1
_LONG_INDEX_LIMIT = _SHORT_INDEX_LIMIT * 256
"""Largest number of messages with a header of one byte, or of two."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameFormat:
    """Division of a frame of a given size into messages."""

    n_taxels: int
    """Samples in a frame."""
    sample_bytes: int
    """1 or 2."""

    def __post_init__(self) -> None:
        if self.n_messages > _LONG_INDEX_LIMIT:
            raise LayoutError(
                f"{self.n_taxels} taxels need {self.n_messages} messages a frame, allowed are "
                f"{_LONG_INDEX_LIMIT}; use fewer taxels"
            )

    @classmethod
    def of(cls, layout: TaxelLayout) -> "FrameFormat":
        """Return the format of a layout's frames."""
        return cls(n_taxels=layout.n_taxels, sample_bytes=layout.sample_bits // 8)

    @property
    def _content_bytes(self) -> int:
        return self.n_taxels * self.sample_bytes + _TRAILER.size

    @property
    def header_bytes(self) -> int:
        """Bytes of the header of each message: 1 or 2."""
        return 1 if self._content_bytes <= _SHORT_INDEX_LIMIT * (MESSAGE_BYTES - 1) else 2

    @property
    def n_messages(self) -> int:
        """Messages of one frame."""
        return -(-self._content_bytes // (MESSAGE_BYTES - self.header_bytes))


def crc16_ccitt(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF."""
    return binascii.crc_hqx(data, CRC_START)


class _Burst(NamedTuple):
    """The messages of one frame so far."""

    phase: int
    begun_s: float
    parts: dict[int, bytes]
    """Messages by index, in the order of arrival."""


class FrameAssembler:
    """Collects messages by index, in any order, and returns only complete frames.

    Two bursts are open at a time: the newest and the previous one. Each has only messages of its
    own phase, so a late message completes its own frame and never another one. A frame is returned
    if all its messages are present, the CRC over all data is right, and its counter fits its phase
    and is newer than that of the last frame.

    Parameters
    ----------
    order : (n_taxels,) int64
        Place in a burst of each taxel of a frame; None for the same order.
    """

    def __init__(self, frame_format: FrameFormat, order: NDArray[np.int64] | None = None) -> None:
        self._format, self._order = frame_format, order
        self._n = frame_format.n_messages
        self._long_header = frame_format.header_bytes == 2
        self._dtype = f"<u{frame_format.sample_bytes}"
        self._open: dict[int, _Burst] = {}
        self._newest: _Burst | None = None
        self._last_counter: int | None = None
        self.counts = FrameStatistics()
        """Counts so far; they are updated."""

    def push(self, data: bytes | bytearray, t_s: float) -> TactileFrame | None:
        """Add one message and return the frame that it completes, if any."""
        if len(data) != MESSAGE_BYTES:
            self.counts.short += 1
            return None
        head = data[0]
        index = head & _INDEX_BITS
        if self._long_header:
            index = index << 8 | data[1]
        if index >= self._n:
            self.counts.corrupt += 1
            return None
        phase = head >> PHASE_SHIFT
        burst = self._open.get(phase)
        part = None if burst is None else burst.parts.get(index)
        if part == data:
            self.counts.duplicate += 1
            return None
        if burst is None or part is not None:
            # Same phase, other content: four scans later. The two must not share messages.
            left_open = None if burst is self._newest else self._newest
            self._give_up_all_but(left_open)
            burst = self._newest = self._open[phase] = _Burst(phase, t_s, {})
        before = next(reversed(burst.parts), -1)
        self.counts.reordered += index < before or burst is not self._newest
        burst.parts[index] = bytes(data)
        return self._finish(burst, t_s) if len(burst.parts) == self._n else None

    def _give_up_all_but(self, left_open: _Burst | None) -> None:
        """Close all bursts except one; those with missing messages are torn."""
        closed = (burst for burst in self._open.values() if burst is not left_open)
        self.counts.torn += sum(len(burst.parts) < self._n for burst in closed)
        self._open = {} if left_open is None else {left_open.phase: left_open}

    def _finish(self, burst: _Burst, t_s: float) -> TactileFrame | None:
        header = self._format.header_bytes
        in_order = b"".join([burst.parts[index] for index in range(self._n)])
        whole = np.frombuffer(in_order, dtype=np.uint8)
        payload = whole.reshape(self._n, MESSAGE_BYTES)[:, header:].tobytes()
        if burst is self._newest:
            # The previous burst is over. Another message of its phase is a late duplicate. After
            # two lost frames it is a new frame, which must not be compared with it.
            self._give_up_all_but(burst)
        counter, status, crc = _TRAILER.unpack(payload[-_TRAILER.size :])
        if crc16_ccitt(payload[:-CRC_BYTES]) != crc or counter % _PHASES != burst.phase:
            self.counts.corrupt += 1
            return None
        if self._last_counter is not None:
            step = (counter - self._last_counter) & COUNTER_MASK
            if step == 0 or step >= _HALF_TURN:
                self.counts.stale += 1
                return None
            self.counts.lost += step - 1
        self._last_counter = counter
        self.counts.complete += 1
        counts = np.frombuffer(payload, dtype=self._dtype, count=self._format.n_taxels)
        counts = counts.astype(np.uint16)
        if self._order is not None:
            counts = counts[self._order]
        counts.setflags(write=False)
        return TactileFrame(
            t_s=t_s, counter=counter, status=status, counts=counts, begun_s=burst.begun_s
        )


FORCE_N = 0.002
"""Unit of a force in N: from -65 to 65 N."""
CENTRE_TAXELS = 1.0 / 16.0
"""Unit of a centre in pitches of the taxels: from -8 to 8."""
TABLE_NODES = 129
"""Nodes of the table of one pad, evenly from 0 counts to full scale; linear between them."""
TABLE_N = 0.0005
"""Unit of the table's forces in N: up to 32 N a taxel."""
ZERO_STEPS = 60_000
"""Steps of a zero, and of the threshold, in the full scale of the counts."""
BAD_TAXEL = 0xFFFF
"""Zero of a taxel that does not measure: its neighbours are used instead."""
COUNTERS = 16
"""Number of counters before a counter repeats."""
_NO_CENTRE = -128
"""Centre without a touch."""
_BODY = struct.Struct("<Bhhbb")
_STATUS_SHIFT = 4
_CRC8_POLYNOMIAL, _CRC8_START, _CRC8_END = 0x11D, 0xFF, 0xFF
"""CRC-8 of SAE J1850 (AUTOSAR, Specification of CRC Routines, 7.2.1.1)."""


def _divided(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (_CRC8_POLYNOMIAL if byte & 0x80 else 0)
    return byte


_CRC8_TABLE = bytes(map(_divided, range(256)))


def crc8(data: bytes | bytearray) -> int:
    """Return the CRC-8 of SAE J1850."""
    crc = _CRC8_START
    for byte in data:
        crc = _CRC8_TABLE[crc ^ byte]
    return crc ^ _CRC8_END


def decode_force_message(data: bytes | bytearray, t_s: float) -> ForceMessage | None:
    """Return the message in 8 bytes received at ``t_s`` s; None for a damaged one."""
    body = data[: _BODY.size]
    if len(data) != MESSAGE_BYTES or crc8(body) != data[-1]:
        return None
    head, first, second, along, across = _BODY.unpack(body)
    return ForceMessage(
        t_s=t_s,
        counter=head % COUNTERS,
        status=ScanStatus(head >> _STATUS_SHIFT),
        force_n=(first * FORCE_N, second * FORCE_N),
        centre_taxels=None
        if along == _NO_CENTRE
        else (along * CENTRE_TAXELS, across * CENTRE_TAXELS),
    )


ForceLaw = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Forces in N of tared counts, (..., n_taxels) both: `Calibration.force_n` of the sensor."""


def force_table(layout: TaxelLayout, law: ForceLaw, *, exchanged: bool = False) -> bytes:
    """Return object 0x2141, the table of counts to force of both gripping pads.

    ``exchanged``: each of them has the place of the other one in the unit.
    """
    counts = np.linspace(0.0, layout.adc_max, TABLE_NODES)
    force_n = law(np.repeat(counts[:, np.newaxis], layout.n_taxels, axis=1))
    places = layout.gripping_taxels[::-1] if exchanged else layout.gripping_taxels
    table_n = np.stack([force_n[:, taxels].mean(axis=1) for taxels in places])
    if not np.isfinite(table_n).all():
        raise FrameError("the calibration has forces that are not finite: correct it")
    return _with_crc(np.clip(np.rint(table_n / TABLE_N), 0, 0xFFFF))


def encode_zero(
    touch_counts: float, zero_counts: NDArray[np.float64], bad: NDArray[np.bool_], adc_max: int
) -> bytes:
    """Return the object of the zero.

    Parameters
    ----------
    touch_counts
        Least counts above the zero of a touched taxel, in the mean of its neighbourhood.
    zero_counts : (n,) float64
        Zero of each taxel of the gripping pads, finger 0 first.
    bad : (n,) bool
        Taxels that do not measure.
    """
    steps = np.append(touch_counts, zero_counts) * (ZERO_STEPS / adc_max)
    steps = np.clip(np.rint(steps), 0, ZERO_STEPS)
    steps[1:][bad] = BAD_TAXEL
    return _with_crc(steps)


def _with_crc(numbers: NDArray[Any]) -> bytes:
    content = numbers.astype("<u2").tobytes()
    return content + crc16_ccitt(content).to_bytes(CRC_BYTES, "little")
