"""Messages of uSkin boards on CAN: the start of a board, and the samples of one taxel. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

from tactile.errors import LayoutError
from tactile.layout import TaxelLayout

START = b"\x07\x00"
"""Data of the message that starts a board."""
FULL_SCALE = 0xFFFF
"""Largest sample: 16 bit."""
PERIOD_S = 0.01
"""Usual period of the samples in s."""
_SAMPLES = Struct(">xHHH")
"""Byte 0 is not used; x, y and z follow, high byte first."""
START_ID, FIRST_ID = 0x200, 0x700
"""Start identifier of board 0, and identifier of its first taxel. Further boards of the XR1944
follow at 1 and 10h. Others have seen only board 1: those of board 2 are likely."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardIds:
    """Identifiers of one board."""

    start: int
    """Identifier of its start message."""
    taxels: tuple[int, ...]
    """Identifier of the samples of each taxel, row by row along the finger."""


def xr1944(board: int, n_taxels: int = 16) -> BoardIds:
    """Return the identifiers of an XR1944 with the address ``board``."""
    first = FIRST_ID + 0x10 * board
    return BoardIds(start=START_ID + board, taxels=tuple(range(first, first + n_taxels)))


def samples(data: bytes | bytearray) -> tuple[int, int, int] | None:
    """Return x, y and z of a taxel; None for a message that is too short."""
    return _SAMPLES.unpack_from(data) if len(data) >= _SAMPLES.size else None


def check_layout(layout: TaxelLayout, boards: Sequence[BoardIds]) -> None:
    """Raise LayoutError where a layout does not fit the taxels of two boards, or ids repeat."""
    # A start may have a taxel's identifier, as 203h of newer boards: its direction is the opposite.
    for ids in ([i for board in boards for i in board.taxels], [board.start for board in boards]):
        if len(set(ids)) < len(ids):
            raise LayoutError("identifiers of the boards repeat: each taxel and start has its own")
    sizes = [pad.n_taxels for pad in layout.pads]
    counts = [len(boards[pad.finger].taxels) for pad in layout.pads]
    if len(layout.pads) != len(boards) or sizes != counts:
        raise LayoutError(
            f"layout {layout.name} has pads of {sizes} taxels, the boards have {counts}: one inner "
            "pad for each board, with as many taxels as it has identifiers"
        )
