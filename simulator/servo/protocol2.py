"""DYNAMIXEL Protocol 2.0 on the wire: checksum, byte stuffing, packets and a strict parser.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". An instruction packet is
``FF FF FD 00 | ID | LEN | INST | parameters | CRC``, a status packet has 55 as its instruction and
the error byte as its first parameter. From INST to the last parameter an FD is inserted after every
``FF FF FD``; LEN and CRC count the inserted bytes.
"""

import struct
from array import array
from enum import IntEnum
from typing import NamedTuple

import numpy as np

HEADER = b"\xff\xff\xfd"
"""First three bytes of a packet; a byte that is not FD follows."""
BROADCAST_ID = 0xFE
"""ID of all servos."""
STATUS = 0x55
"""Instruction code of a status packet."""
MAX_LENGTH = 1024
"""Largest LEN of a packet; for the parser a larger value means a damaged header."""

_START = HEADER + b"\x00"
_ID_AND_LENGTH = struct.Struct("<BH")
_STUFFED = HEADER + b"\xfd"
_OVERHEAD = 7
"""Bytes before INST: header, reserved byte, ID, LEN."""
_CRC_SIZE = 2
_CRC_POLYNOMIAL = 0x8005
"""Polynomial of the CRC-16 (e-Manual, "CRC Calculation")."""


class Instruction(IntEnum):
    """Instruction codes of Protocol 2.0 that a servo carries out."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    BULK_READ = 0x92
    BULK_WRITE = 0x93


class StatusError(IntEnum):
    """Error numbers in bits 0 to 6 of the error byte of a status packet."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


ALERT = 0x80
"""Bit 7 of the error byte: Hardware Error Status is not zero."""


def _pair_crcs() -> list[int]:
    crcs = np.arange(1 << 16)
    for _ in range(16):
        crcs = crcs << 1 ^ np.where(crcs & 0x8000, _CRC_POLYNOMIAL, 0)
    return list((crcs & 0xFFFF).tolist())


_PAIR_CRCS = array("H", _pair_crcs())
"""CRC of each pair of bytes."""


def crc16(data: bytes | bytearray) -> int:
    """Return the CRC-16 of Protocol 2.0 (polynomial 8005, initial value 0, no reflection)."""
    crc, n_pairs = 0, (len(data) + 1) // 2
    # At this initial value a zero before the data changes nothing.
    for pair in struct.unpack(f">{n_pairs}H", data.rjust(2 * n_pairs, b"\0")):
        crc = _PAIR_CRCS[crc ^ pair]
    return crc


def encode_packet(packet_id: int, body: bytes) -> bytes:
    """Return a packet with a body from INST to the last parameter, which is stuffed here."""
    body = body.replace(HEADER, _STUFFED)
    head = _START + _ID_AND_LENGTH.pack(packet_id, len(body) + _CRC_SIZE) + body
    return head + crc16(head).to_bytes(_CRC_SIZE, "little")


def encode_status(packet_id: int, error: int, parameters: bytes) -> bytes:
    """Return the status packet of a servo; ``error`` is the whole error byte."""
    return encode_packet(packet_id, bytes((STATUS, error)) + parameters)


class Packet(NamedTuple):
    """One parsed packet."""

    packet_id: int
    """ID field: 0 to 252 or `BROADCAST_ID`."""
    instruction: int
    """Instruction code; `STATUS` for a status packet."""
    parameters: bytes
    """Parameters with the stuffing removed (error byte first in a status packet)."""
    intact: bool
    """False when the checksum is wrong: nothing in the packet may be used."""


class PacketParser:
    """Finds packets in a stream of bytes, as strictly as a servo.

    A packet that holds another header was not stuffed, or was cut off: it is passed over. After a
    wrong checksum the search continues behind the header: if bytes were lost, the next packet may
    begin there.
    """

    def __init__(self) -> None:
        self._buffer = b""

    def reset(self) -> None:
        """Drop the bytes of an incomplete packet."""
        self._buffer = b""

    def push(self, data: bytes) -> list[Packet]:
        """Take bytes from the wire and return the completed packets in order."""
        buffer, packets = self._buffer + data, list[Packet]()
        while (start := buffer.find(_START)) >= 0:
            buffer = buffer[start:]
            if len(buffer) < _OVERHEAD:
                break
            packet_id, length = _ID_AND_LENGTH.unpack_from(buffer, len(_START))
            end = _OVERHEAD + length
            if 3 <= length <= MAX_LENGTH and len(buffer) < end:
                break
            body, crc = buffer[_OVERHEAD : end - _CRC_SIZE], buffer[end - _CRC_SIZE : end]
            whole = 3 <= length <= MAX_LENGTH and HEADER not in body.replace(_STUFFED, b"")
            intact = crc16(buffer[: end - _CRC_SIZE]) == int.from_bytes(crc, "little")
            if whole:
                body = body.replace(_STUFFED, HEADER)
                packets.append(Packet(packet_id, body[0], body[1:], intact))
            buffer = buffer[end if whole and intact else len(_START) :]
        self._buffer = buffer if start >= 0 else buffer[-len(HEADER) :]
        return packets
