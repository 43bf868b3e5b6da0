"""The SDK's packet handler, sending and receiving what the protocol demands."""

from collections.abc import Sequence
from enum import IntEnum

from dynamixel_sdk import COMM_PORT_BUSY, COMM_RX_TIMEOUT, COMM_SUCCESS, Protocol2PacketHandler

from gripper.errors import BusBusy
from gripper.packets import (
    HEADER,
    STATUS_OVERHEAD,
    StatusPacket,
    packet_length,
    parse_status,
    stuff,
    unstuff,
)
from gripper.port import SdkPort

_READ_AHEAD = 256
"""Bytes asked for at once: answers that came together are fetched together."""
_CRC_TABLE = tuple(Protocol2PacketHandler().updateCRC(0, (byte,), 1) for byte in range(256))
"""The SDK's own table; its method makes it anew with every call."""


class Instruction(IntEnum):
    """Instructions of Protocol 2.0 that the bus uses."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REBOOT = 0x08
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83


class CheckedPacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's Protocol 2.0 with byte stuffing that reaches the wire and a strict receiver.

    Length and CRC are computed over the stuffed bytes; the receiver checks the CRC before it
    removes the stuffing, and starts again at the next header after damaged bytes.

    Attributes
    ----------
    dropped_bytes
        Bytes that the last `receive` passed over.
    """

    def __init__(self) -> None:
        super().__init__()
        self.dropped_bytes = 0
        self._following = bytearray()

    def send(self, port: SdkPort, servo_id: int, instruction: int, params: bytes) -> None:
        """Send one instruction packet; BusBusy while the port waits for another answer."""
        length = len(params) + 3
        packet = [0, 0, 0, 0, servo_id, length & 0xFF, length >> 8, instruction, *params, 0, 0]
        if self.txPacket(port, packet) != COMM_SUCCESS:
            raise BusBusy("the SDK's port is still in use by another transaction")

    def receive(self, port: SdkPort) -> StatusPacket | None:
        """Return the next status packet whose CRC is right, None at the port's time-out."""
        self.dropped_bytes = 0
        # More bytes than one packet may have been read: the next one is among them.
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
            data = port.readPort(max(missing, _READ_AHEAD))
            buffer += data
            if not data and port.isPacketTimeout():
                if not buffer:
                    return None
                # A damaged length may hide a whole packet further on.
                self._skip(buffer)

    def txPacket(self, port: SdkPort, txpacket: Sequence[int]) -> int:  # noqa: N802
        """Send a packet whose header, length and CRC are still to be filled in."""
        if port.is_using:
            return int(COMM_PORT_BUSY)
        port.is_using = True
        body = stuff(bytes(txpacket[7:-2]))
        length = len(body) + 2
        packet = HEADER + bytes([0, txpacket[4], length & 0xFF, length >> 8]) + body
        packet += self.updateCRC(0, packet, len(packet)).to_bytes(2, "little")
        self._following.clear()
        port.clearPort()
        port.writePort(packet)
        return int(COMM_SUCCESS)

    def updateCRC(  # noqa: N802
        self, crc_accum: int, data_blk_ptr: Sequence[int], data_blk_size: int
    ) -> int:
        """Return the CRC of the first bytes, continued from ``crc_accum``."""
        crc = crc_accum
        for byte in data_blk_ptr[:data_blk_size]:
            crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
        return crc

    def rxPacket(self, port: SdkPort, fast_option: bool) -> tuple[list[int], int]:  # noqa: N802
        """Receive for the SDK's own methods; fast reads are not used."""
        if fast_option:
            raise NotImplementedError("fast reads are not used: use ServoBus.sync_read")
        status = self.receive(port)
        port.is_using = False
        if status is None:
            return [], int(COMM_RX_TIMEOUT)
        length = len(status.data) + 4
        error = status.error | (0x80 if status.alert else 0)
        head = [*HEADER, 0, status.servo_id, length & 0xFF, length >> 8, 0x55, error]
        return [*head, *status.data, 0, 0], int(COMM_SUCCESS)

    def addStuffing(self, packet: Sequence[int]) -> list[int]:  # noqa: N802
        """Return a packet with its body stuffed and its length corrected; the CRC is kept."""
        return _with_body(packet, stuff(bytes(packet[7:-2])))

    def removeStuffing(self, packet: Sequence[int]) -> list[int]:  # noqa: N802
        """Return a packet with its body unstuffed and its length corrected; the CRC is kept."""
        return _with_body(packet, unstuff(bytes(packet[7:-2])))

    def _missing(self, buffer: bytearray) -> int:
        """Return how many bytes the packet at the start still lacks; drops what starts none."""
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
        del buffer[:count]

    def _crc_is_right(self, packet: bytes) -> bool:
        crc = self.updateCRC(0, packet, len(packet) - 2)
        return bool(crc == int.from_bytes(packet[-2:], "little"))


def _with_body(packet: Sequence[int], body: bytes) -> list[int]:
    length = len(body) + 2
    return [*packet[:5], length & 0xFF, length >> 8, *body, *packet[-2:]]
