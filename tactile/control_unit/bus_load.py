"""Load of the CAN bus by a control unit, and the least period of its frames."""

from math import inf

from tactile.control_unit.settings import WINDOW_SHARE, LinkSettings
from tactile.frames.codec import MESSAGE_BYTES, FrameFormat
from tactile.layout import TaxelLayout


def message_bits(n_bytes: int) -> int:
    """Return the largest length in bits of a message with an identifier of 11 bits.

    ISO 11898-1: 47 bits in addition to the data, and one stuff bit for four bits that are stuffed.
    """
    return 47 + 8 * n_bytes + (33 + 8 * n_bytes) // 4


def _other_share(settings: LinkSettings, bitrate: int) -> float:
    """Return the load by force messages and heartbeats as a share of the bus."""
    bits_s = message_bits(1) / settings.heartbeat_s
    if settings.force_period_s:
        bits_s += message_bits(MESSAGE_BYTES) / settings.force_period_s
    return bits_s / bitrate


def _frame_bits(layout: TaxelLayout) -> int:
    return FrameFormat.of(layout).n_messages * message_bits(MESSAGE_BYTES)


def bus_load(layout: TaxelLayout, settings: LinkSettings, bitrate: int) -> float:
    """Return the largest load of a bus at ``bitrate`` bit/s as a share; above 1 is impossible."""
    period_bits = _frame_bits(layout) + message_bits(0)
    return period_bits / settings.sync_period_s / bitrate + _other_share(settings, bitrate)


def least_sync_period_s(layout: TaxelLayout, settings: LinkSettings, bitrate: int) -> float:
    """Return the least period of SYNC in s for a complete frame; inf if there is none.

    The burst of a frame must end in the synchronous window, and all other messages have priority.
    """
    left_bits_s = bitrate * (1.0 - _other_share(settings, bitrate))
    if left_bits_s <= 0.0:
        return inf
    return (_frame_bits(layout) / WINDOW_SHARE + message_bits(0)) / left_bits_s
