"""DYNAMIXEL Protocol 2.0: packets as pure functions, and the SDK's packet handler made strict.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". The SDK computes length and CRC before byte
stuffing; here both cover the stuffed bytes, and the CRC is checked before a packet is unstuffed.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

from dynamixel_sdk import COMM_PORT_BUSY, COMM_SUCCESS, Protocol2PacketHandler

from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import BusBusy

HEADER = b"\xff\xff\xfd"
"""First bytes of every packet; inside a packet they are stuffed."""
STATUS_INSTRUCTION = 0x55
"""Instruction byte of a status packet."""
ALERT_BIT = 0x80
"""Bit of the error byte that is set while Hardware Error Status (register 70) is not zero."""
STATUS_OVERHEAD = 11
"""Bytes of a status packet without its parameters."""

_START = HEADER + b"\x00"
"""Header and reserved byte."""
_ID_AT, _LENGTH_AT, _BODY_AT = 4, 5, 7
"""Offsets of ID, length (2 bytes) and instruction in a packet."""
_HIGHEST_ID_BYTE = 0xFE
"""Highest content of the ID byte: the broadcast ID."""
_CRC_SIZE = 2
"""Bytes of the CRC at the end of a packet."""
_LONGEST_LENGTH = 1024
"""Longest accepted length field. The answers here are below 300 bytes, and a damaged length must
not hide the next packet."""
_READ_AHEAD = 256
"""Bytes per read: answers that arrived together are read together."""
_CRC_TABLE = tuple(Protocol2PacketHandler().updateCRC(0, (byte,), 1) for byte in range(256))
"""The SDK's own table; its method calculates it again with every call."""
_SHOWN_BYTES = 16
"""Dropped bytes kept for an error message: a header and the following bytes."""


class Instruction(IntEnum):
    """Instructions of Protocol 2.0 that the bus uses."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class StatusPacket(NamedTuple):
    """A status packet whose CRC is right."""

    servo_id: int
    """ID of the servo that answered."""
    error: int
    """Error number 0 to 7, without the Alert bit."""
    alert: bool
    """True while Hardware Error Status (register 70) is not zero."""
    data: bytes
    """Parameters, unstuffed."""


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
    there = len(buffer)
    if buffer[:_ID_AT] != _START[:there]:
        return 0
    if there > _ID_AT and buffer[_ID_AT] > _HIGHEST_ID_BYTE:
        return 0
    if there < _BODY_AT:
        return None
    length = buffer[_LENGTH_AT] | buffer[_LENGTH_AT + 1] << 8
    if not STATUS_OVERHEAD - _BODY_AT <= length <= _LONGEST_LENGTH:
        return 0
    return _BODY_AT + length


def parse_status(packet: bytes) -> StatusPacket | None:
    """Return the content of a whole packet; None for an instruction (an echo of a request)."""
    body = unstuff(packet[_BODY_AT:-_CRC_SIZE])
    if len(body) < 2 or body[0] != STATUS_INSTRUCTION:
        return None
    error = body[1]
    return StatusPacket(
        servo_id=packet[_ID_AT],
        error=error & ~ALERT_BIT & 0xFF,
        alert=bool(error & ALERT_BIT),
        data=body[2:],
    )


class CheckedPacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's Protocol 2.0 with byte stuffing that reaches the wire and a strict receiver.

    The receiver starts again at the next header after damaged bytes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.dropped_bytes = 0
        self.dropped_head = b""
        """Number and first bytes of the data that the last `receive` dropped."""
        self._following = bytearray()

    def receive(self, port: SdkPort) -> StatusPacket | None:
        """Return the next status packet with a correct CRC; None at the port's time-out.

        If bytes arrive without a pause, the wait ends one longest packet after the time-out. Bytes
        that arrived while the program was stopped are still read once.
        """
        looked_late = port.is_using = False
        self.dropped_bytes, self.dropped_head = 0, b""
        # More bytes than one packet may have been read: they contain the next one.
        buffer, self._following = self._following, bytearray()
        while True:
            missing = self._missing(buffer)
            if missing == 0:
                whole = packet_length(buffer) or 0
                packet = bytes(buffer[:whole])
                status = parse_status(packet) if self._crc_is_right(packet) else None
                if status is not None:
                    self._following = buffer[whole:]
                    return status
                self._skip(buffer)
                continue
            chatter = looked_late and port.is_overdue(_BODY_AT + _LONGEST_LENGTH)
            looked_late = looked_late or port.isPacketTimeout()
            data = b"" if chatter else port.readPort(max(missing, _READ_AHEAD))
            buffer += data
            if not data and port.isPacketTimeout():
                if not buffer:
                    return None
                # A damaged length may hide a whole packet further on.
                self._skip(buffer)

    def txPacket(self, port: SdkPort, txpacket: Sequence[int]) -> int:  # noqa: N802
        """Send a packet after its header, length and CRC are filled in."""
        params = bytes(txpacket[_BODY_AT + 1 : -_CRC_SIZE])
        try:
            self.send(port, txpacket[_ID_AT], txpacket[_BODY_AT], params)
        except BusBusy:
            return int(COMM_PORT_BUSY)
        return int(COMM_SUCCESS)

    def send(self, port: SdkPort, servo_id: int, instruction: int, params: bytes) -> None:
        """Send one instruction packet; BusBusy while the port waits for another answer."""
        if port.is_using:
            raise BusBusy("the SDK's port is still in use by another transaction")
        port.is_using = True
        body = stuff(bytes((instruction,)) + params)
        length = (len(body) + _CRC_SIZE).to_bytes(2, "little")
        packet = _START + bytes((servo_id,)) + length + body
        packet += self.updateCRC(0, packet, len(packet)).to_bytes(_CRC_SIZE, "little")
        self._following.clear()
        port.clearPort()
        port.writePort(packet)

    def updateCRC(  # noqa: N802
        self, crc_accum: int, data_blk_ptr: Sequence[int], data_blk_size: int
    ) -> int:
        """Return the CRC of the first bytes, continued from ``crc_accum``."""
        crc = crc_accum
        for byte in data_blk_ptr[:data_blk_size]:
            crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
        return crc

    def _missing(self, buffer: bytearray) -> int:
        """Return the number of missing bytes of the first packet; drops bytes before it."""
        while True:
            whole = packet_length(buffer)
            if whole == 0:
                self._skip(buffer)
                continue
            return max(0, (whole or STATUS_OVERHEAD) - len(buffer))

    def _skip(self, buffer: bytearray) -> None:
        """Drop bytes up to the next possible header."""
        following = buffer.find(HEADER[0], 1)
        count = following if following > 0 else len(buffer)
        self.dropped_bytes += count
        if len(self.dropped_head) < _SHOWN_BYTES:
            self.dropped_head = (self.dropped_head + bytes(buffer[:count]))[:_SHOWN_BYTES]
        del buffer[:count]

    def _crc_is_right(self, packet: bytes) -> bool:
        crc = self.updateCRC(0, packet, len(packet) - _CRC_SIZE)
        return bool(crc == int.from_bytes(packet[-_CRC_SIZE:], "little"))
