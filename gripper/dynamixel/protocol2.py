"""DYNAMIXEL Protocol 2.0: packets on a serial line, with their checksum, stuffing and time-outs.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". Length and CRC of a packet cover its stuffed
bytes.
"""

import struct
from enum import IntEnum
from typing import NamedTuple, NoReturn, Protocol

from gripper.clock import Clock
from gripper.errors import PortLost

BROADCAST_ID = 0xFE
"""ID that all servos listen to (e-Manual, Protocol 2.0, "Packet ID")."""
HIGHEST_ID = 252
"""Highest ID of a servo (e-Manual, Protocol 2.0, "Packet ID")."""
STATUS_OVERHEAD = 11
"""Bytes of a status packet without its parameters."""

_ALERT_BIT = 0x80
"""Bit of the error byte that is set while Hardware Error Status (register 70) is not zero."""
_STATUS = 0x55
"""Instruction byte of a status packet."""
_START = b"\xff\xff\xfd\x00"
"""First bytes of every packet."""
_HEADER, _STUFFED = b"\xff\xff\xfd", b"\xff\xff\xfd\xfd"
"""The same bytes inside a packet, before and after stuffing."""
_ID_AT, _LENGTH_AT, _BODY_AT = 4, 5, 7
"""Offsets of ID, length (2 bytes) and instruction in a packet."""
_CRC_SIZE = 2
"""Bytes of the CRC at the end of a packet."""
_CRC_POLYNOMIAL = 0x8005
"""Of the CRC-16, which begins with 0 and takes the highest bit first (e-Manual, "CRC")."""
_LONGEST_PACKET = 1031
"""Bytes of the longest packet that is accepted; answers here are below 300 bytes."""
_READ_AHEAD = 256
"""Bytes per read: answers that arrived together are read together."""


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


class ByteStream(Protocol):
    """Both directions of a serial line; raises OSError or PortLost when it is lost."""

    def write(self, data: bytes, /) -> None:
        """Send all bytes."""

    def read(self, size: int, timeout_s: float, /) -> bytes:
        """Return 1 to ``size`` bytes as soon as any is there, b"" after ``timeout_s`` s."""

    def drop_input(self) -> None:
        """Forget what has arrived and was not read."""

    def close(self) -> None:
        """Give the line back; may be called twice."""


class PacketPort:
    """Packets on any `ByteStream`, with blocking reads and monotonic time.

    The time-out of an answer has three parts: time on the wire, return delay of the servo, and an
    allowance for adapter and operating system. Bytes that arrived while the program was stopped
    are still read; if bytes arrive without a pause, reading ends one longest packet after that.

    Parameters
    ----------
    baudrate
        Baud rate in bit/s that the line has; 10 bits a byte.
    return_delay_s
        Return Delay Time of the slowest servo (register 9) in s.
    """

    def __init__(
        self,
        stream: ByteStream,
        clock: Clock,
        *,
        baudrate: int,
        return_delay_s: float = 0.0005,
        allowance_s: float = 0.0015,
    ) -> None:
        self._clock = clock
        self._byte_s = 10.0 / baudrate
        self.return_delay_s = return_delay_s
        self.allowance_s = allowance_s
        self.dropped = b""
        """Bytes that the last `receive` dropped."""
        self.use(stream)

    def use(self, stream: ByteStream) -> None:
        """Replace a lost stream."""
        self._stream = stream
        self.lost = False
        self._arrived = bytearray()
        self._sent_bytes = 0
        self._deadline_s = self._end_s = 0.0

    def close(self) -> None:
        """Close the stream."""
        self._stream.close()

    def send(self, servo_id: int, instruction: int, params: bytes) -> None:
        """Send one instruction packet, and forget what has arrived."""
        body = (bytes((instruction,)) + params).replace(_HEADER, _STUFFED)
        packet = _START + struct.pack("<BH", servo_id, len(body) + _CRC_SIZE) + body
        self.write(packet + struct.pack("<H", _crc16(packet)))

    def write(self, data: bytes) -> None:
        """Send bytes, and forget what has arrived."""
        self._arrived.clear()
        self._sent_bytes = len(data)
        try:
            self._stream.drop_input()
            self._stream.write(data)
        except (PortLost, OSError) as error:
            self._lose(error)

    def expect(self, n_bytes: int) -> None:
        """Start the time-out for an answer of so many bytes."""
        wire_s = self._byte_s * (n_bytes + self._sent_bytes)
        self._sent_bytes = 0
        self.start_timeout(wire_s + self.return_delay_s + self.allowance_s)

    def start_timeout(self, duration_s: float) -> None:
        """Start a time-out in s."""
        self._deadline_s, self._end_s = self._clock.monotonic() + duration_s, 0.0

    def read(self) -> bytes:
        """Return the next bytes, b"" once the time-out is over and nothing is left to read."""
        now_s = self._clock.monotonic()
        left_s = max(0.0, self._deadline_s - now_s)
        if left_s <= 0.0:
            self._end_s = self._end_s or now_s + _LONGEST_PACKET * self._byte_s
            if now_s > self._end_s:
                return b""
        try:
            return self._stream.read(_READ_AHEAD, left_s)
        except (PortLost, OSError) as error:
            self._lose(error)

    def receive(self) -> StatusPacket | None:
        """Return the next status packet with a right CRC; None at the time-out.

        After damaged bytes it starts again at the next possible start of a packet. A damaged length
        may hide a whole packet: at the time-out it is looked for.
        """
        arrived, start, timed_out = self._arrived, 0, False
        while True:
            at = arrived.find(_START, start)
            end = _end(arrived, at)
            whole = at >= 0 and end <= len(arrived)
            if whole and (status := _status(arrived[at:end])) is not None:
                self.dropped = bytes(arrived[:at])
                del arrived[:end]
                return status
            if whole or (timed_out and at >= 0):
                start = at + 1
            elif timed_out:
                self.dropped = bytes(arrived)
                arrived.clear()
                return None
            else:
                data = self.read()
                timed_out = not data
                arrived += data

    def _lose(self, error: PortLost | OSError) -> NoReturn:
        """Note the loss of the stream, and raise it as PortLost."""
        self.lost = True
        if isinstance(error, PortLost):
            raise error
        raise PortLost(f"the servo line is lost: {error}") from error


def _end(data: bytearray, start: int) -> int:
    """Return the end of the packet at a start; it may lie beyond the data."""
    body = start + _BODY_AT
    if len(data) < body:
        return body
    length = data[start + _LENGTH_AT] + 256 * data[start + _LENGTH_AT + 1]
    # A longer one is damaged, and not waited for.
    return body + length if _BODY_AT + length <= _LONGEST_PACKET else body


def _status(packet: bytearray) -> StatusPacket | None:
    """Return the content of a status packet; None for a damaged one, and for an echo."""
    if len(packet) < STATUS_OVERHEAD or packet[_BODY_AT] != _STATUS:
        return None
    if _crc16(packet[:-_CRC_SIZE]) != int.from_bytes(packet[-_CRC_SIZE:], "little"):
        return None
    _, error, *data = packet[_BODY_AT:-_CRC_SIZE].replace(_STUFFED, _HEADER)
    return StatusPacket(packet[_ID_AT], error % _ALERT_BIT, error >= _ALERT_BIT, bytes(data))


def _crc_of(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = crc << 1 ^ (_CRC_POLYNOMIAL if crc & 0x8000 else 0)
    return crc & 0xFFFF


_CRC_TABLE = tuple(map(_crc_of, range(256)))


def _crc16(data: bytes | bytearray) -> int:
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc
