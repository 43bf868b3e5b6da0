"""Messages of uSkin boards on CAN: the start of a board, and the samples of one taxel. Pure."""

from dataclasses import dataclass
from struct import Struct

START = b"\x07\x00"
"""Data of the message that starts a board."""
FULL_SCALE = 0xFFFF
"""Largest sample: 16 bit."""
PERIOD_S = 0.01
"""Usual period of the samples in s."""
_SAMPLES = Struct(">xHHH")
"""Byte 0 is not for us; x, y and z, high byte first."""
START_ID, FIRST_ID = 0x200, 0x700
"""Start identifier of board 0, and identifier of its first taxel; further boards of the XR1944
follow at 1 and 10h. Only board 1 was seen by others: those of board 2 are likely."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardIds:
    """Identifiers of one board."""

    start: int
    """Of the message that starts it."""
    taxels: tuple[int, ...]
    """Of the samples of each taxel, row by row along the finger."""


def xr1944(board: int, n_taxels: int = 16) -> BoardIds:
    """Return the identifiers of an XR1944 whose address is ``board``."""
    first = FIRST_ID + 0x10 * board
    return BoardIds(start=START_ID + board, taxels=tuple(range(first, first + n_taxels)))


def samples(data: bytes | bytearray) -> tuple[int, int, int] | None:
    """Return x, y and z of a taxel; None for a message that is too short."""
    return _SAMPLES.unpack_from(data) if len(data) >= _SAMPLES.size else None
