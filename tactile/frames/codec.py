"""The format of the tactile transport: one frame of samples in one burst of 8-byte messages. Pure.

A message is a header and data. The header has the frame's phase (counter modulo 4) in the two top
bits, then the message's index in the burst. It has one byte for up to 64 messages, else two (high
byte first). The data of all messages of a burst in order are the samples (u8 or u16 little-endian),
zero bytes up to the trailer, and the trailer at the end of the last message. The trailer is the
frame counter u16 LE, status u8, and CRC-16/CCITT-FALSE u16 LE over all data before it.
"""

import binascii
import struct
from dataclasses import dataclass

from tactile.errors import LayoutError
from tactile.layout import TaxelLayout

MESSAGE_BYTES = 8
"""Data bytes of every message: all that a classic CAN message has."""
TRAILER = struct.Struct("<HBH")
"""End of the last message: frame counter, status, CRC."""
CRC_BYTES = 2
CRC_START = 0xFFFF
"""Start value of CRC-16/CCITT-FALSE."""
PHASES = 4
"""Number of phases, the counter's two lowest bits."""
PHASE_SHIFT = 6
"""The phase is in the two top bits of the first header byte."""
INDEX_BITS = 0x3F
"""Bits of the message's index, or of its high byte, in the first header byte."""
_SHORT_INDEX_LIMIT = INDEX_BITS + 1
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
        if self.sample_bytes not in (1, 2):
            raise LayoutError(f"{self.sample_bytes} bytes a sample, must be 1 or 2")
        if self.n_taxels < 1:
            raise LayoutError(f"{self.n_taxels} taxels, must be at least 1")
        if self.n_messages > _LONG_INDEX_LIMIT:
            raise LayoutError(
                f"{self.n_taxels} taxels need {self.n_messages} messages a frame, allowed are "
                f"{_LONG_INDEX_LIMIT}; use fewer taxels"
            )

    @classmethod
    def of(cls, layout: TaxelLayout) -> "FrameFormat":
        """Return the format of a layout's frames."""
        return cls(n_taxels=layout.n_taxels, sample_bytes=layout.sample_bytes)

    @property
    def samples_bytes(self) -> int:
        """Bytes of all samples of a frame."""
        return self.n_taxels * self.sample_bytes

    @property
    def header_bytes(self) -> int:
        """Bytes of the header of each message: 1 or 2."""
        content = self.samples_bytes + TRAILER.size
        return 1 if content <= _SHORT_INDEX_LIMIT * (MESSAGE_BYTES - 1) else 2

    @property
    def data_bytes(self) -> int:
        """Bytes of data in each message: 7 or 6."""
        return MESSAGE_BYTES - self.header_bytes

    @property
    def n_messages(self) -> int:
        """Messages of one frame."""
        return -(-(self.samples_bytes + TRAILER.size) // self.data_bytes)


def crc16_ccitt(data: bytes) -> int:
    """Return the CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF."""
    return binascii.crc_hqx(data, CRC_START)
