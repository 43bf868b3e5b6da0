"""DYNAMIXEL Protocol 2.0: the packet handler of the SDK, with its stuffing corrected.

Source: ROBOTIS e-Manual, "DYNAMIXEL Protocol 2.0". The SDK builds and finds the packets. Its own
methods send a packet without its stuffing, and lose a byte of a packet that is stuffed twice. With
a damaged packet they also drop a whole one behind it.
"""

from enum import IntEnum
from typing import NamedTuple

from dynamixel_sdk import COMM_PORT_BUSY, COMM_SUCCESS, Protocol2PacketHandler

from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import BusBusy

ALERT_BIT = 0x80
"""Bit of the error byte that is set while Hardware Error Status (register 70) is not zero."""
STATUS_OVERHEAD = 11
"""Bytes of a status packet without its parameters."""

_HEADER = b"\xff\xff\xfd"
"""First bytes of every packet."""
_STUFFED = _HEADER + b"\xfd"
"""The same bytes inside a packet."""
_ID_AT, _LENGTH_AT, _BODY_AT = 4, 5, 7
"""Offsets of ID, length (2 bytes) and instruction in a packet."""
_CRC_SIZE = 2
"""Bytes of the CRC at the end of a packet."""


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


class CheckedPacketHandler(Protocol2PacketHandler):  # type: ignore[misc]
    """The SDK's Protocol 2.0 with byte stuffing that reaches the wire."""

    def __init__(self) -> None:
        super().__init__()
        self.dropped = b""
        """Bytes that the last `receive` dropped."""
        self._whole = 0

    def send(self, port: SdkPort, servo_id: int, instruction: int, params: bytes) -> None:
        """Send one instruction packet; BusBusy while the port waits for another answer."""
        high, low = divmod(len(params) + 1 + _CRC_SIZE, 256)
        packet = [0, 0, 0, 0, servo_id, low, high, instruction, *params, 0, 0]
        if self.txPacket(port, packet) == COMM_PORT_BUSY:
            raise BusBusy("the SDK's port is still in use by another transaction")

    def receive(self, port: SdkPort) -> StatusPacket | None:
        """Return the next status packet with a correct CRC; None at the port's time-out.

        After damaged bytes it starts again at the next possible header.
        """
        port.passed.clear()
        while True:
            packet, result = self.rxPacket(port, False)
            if result == COMM_SUCCESS and self._whole >= STATUS_OVERHEAD:
                self.dropped = bytes(port.passed[: -self._whole])
                error, data = packet[_BODY_AT + 1], packet[_BODY_AT + 2 : -_CRC_SIZE]
                alert = error >= ALERT_BIT
                return StatusPacket(packet[_ID_AT], error % ALERT_BIT, alert, bytes(data))
            if not packet:
                self.dropped = bytes(port.passed)
                return None
            # A damaged length may hide a whole packet further on.
            following = bytes(packet).find(_HEADER[0], 1)
            port.unread(len(packet) - following if following > 0 else 0)

    def addStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Insert FD after every FF FF FD of a packet, in place."""
        body = bytes(packet[_BODY_AT:-_CRC_SIZE])
        if _HEADER in body:
            _change(packet, body.replace(_HEADER, _STUFFED))
        return packet

    def removeStuffing(self, packet: list[int]) -> list[int]:  # noqa: N802
        """Remove the FD after every FF FF FD of a packet, in place."""
        self._whole = _BODY_AT + packet[_LENGTH_AT] + 256 * packet[_LENGTH_AT + 1]
        body = bytes(packet[_BODY_AT:-_CRC_SIZE])
        if _STUFFED in body:
            _change(packet, body.replace(_STUFFED, _HEADER))
        return packet


def _change(packet: list[int], body: bytes) -> None:
    """Replace instruction and parameters of a packet."""
    packet[_BODY_AT:-_CRC_SIZE] = body
    packet[_LENGTH_AT:_BODY_AT] = (len(body) + _CRC_SIZE).to_bytes(2, "little")
