"""DYNAMIXEL Protocol 2.0 packets as pure functions: byte stuffing and status packets.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". The CRC is the caller's business: it covers
the stuffed bytes, so it is checked before a packet is unstuffed.
"""

from dataclasses import dataclass

HEADER = b"\xff\xff\xfd"
STATUS_INSTRUCTION = 0x55
ALERT_BIT = 0x80
STATUS_OVERHEAD = 11
"""Bytes of a status packet without its parameters."""

_PREFIX = 7
_LONGEST_LENGTH = 1024


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusPacket:
    """A status packet whose CRC is right.

    Attributes
    ----------
    servo_id
        Who answered.
    error
        Error number 0 to 7, without the Alert bit.
    alert
        True while Hardware Error Status (register 70) is not zero.
    data
        Parameters, unstuffed.
    """

    servo_id: int
    error: int
    alert: bool
    data: bytes


def stuff(body: bytes) -> bytes:
    """Insert FD after every FF FF FD of an instruction and its parameters."""
    return body.replace(HEADER, HEADER + b"\xfd")


def unstuff(body: bytes) -> bytes:
    """Remove the FD after every FF FF FD; the inverse of `stuff`."""
    return body.replace(HEADER + b"\xfd", HEADER)


def packet_length(buffer: bytes | bytearray) -> int | None:
    """Return the whole length of the packet at the start of ``buffer``.

    None while too few bytes are there; 0 when no status packet can start here.
    """
    head = buffer[:_PREFIX]
    if head[:3] != HEADER[: len(head)] or (len(head) > 3 and head[3] != 0):
        return 0
    if len(head) > 4 and head[4] > 0xFE:
        return 0
    if len(head) < _PREFIX:
        return None
    length = head[5] | head[6] << 8
    if not STATUS_OVERHEAD - _PREFIX <= length <= _LONGEST_LENGTH:
        return 0
    return _PREFIX + length


def parse_status(packet: bytes) -> StatusPacket | None:
    """Take a whole packet apart; None when it is not a status packet (an echo of our own)."""
    body = unstuff(packet[_PREFIX:-2])
    if len(body) < 2 or body[0] != STATUS_INSTRUCTION:
        return None
    return StatusPacket(
        servo_id=packet[4],
        error=body[1] & ~ALERT_BIT & 0xFF,
        alert=bool(body[1] & ALERT_BIT),
        data=body[2:],
    )
