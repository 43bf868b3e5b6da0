import pytest
from dynamixel_sdk import COMM_PORT_BUSY, Protocol2PacketHandler

from gripper.dynamixel.protocol2 import (
    CheckedPacketHandler,
    Instruction,
    packet_length,
    parse_status,
)
from gripper.errors import BusBusy


def test_two_stuffed_places_lose_no_byte() -> None:
    packet = bytes.fromhex("FFFFFD00010B005500FFFFFDFDFFFDFD5460")
    status = parse_status(packet)
    assert status.data == bytes.fromhex("FFFFFDFFFDFD")


@pytest.mark.parametrize(
    ("buffer", "length"),
    [
        ("", None),
        ("FFFF", None),
        ("FFFFFD00010800", 15),
        ("FFFFFDFD", 0),
        ("AA", 0),
        ("FFFFFD00FF", 0),
        ("FFFFFD00010300", 0),
        ("FFFFFD0001E803", 1007),
        ("FFFFFD00010110", 0),
    ],
)
def test_start_of_a_packet(buffer: str, length: int | None) -> None:
    assert packet_length(bytes.fromhex(buffer)) == length


class Wire:
    """A port that keeps what is written and plays back what is to be read."""

    def __init__(self, incoming: bytes = b"") -> None:
        self.is_using = False
        self.sent = b""
        self.incoming = incoming

    def clearPort(self) -> None:  # noqa: N802
        pass

    def writePort(self, packet: bytes) -> int:  # noqa: N802
        self.sent += bytes(packet)
        return len(packet)

    def readPort(self, length: int) -> bytes:  # noqa: N802
        taken, self.incoming = self.incoming[:length], self.incoming[length:]
        return taken

    def isPacketTimeout(self) -> bool:  # noqa: N802
        return not self.incoming

    def is_overdue(self, packet_length: int) -> bool:
        return False


def test_the_sdk_itself_sends_the_stuffed_write_wrongly_and_ours_rightly() -> None:
    data = list((-131073).to_bytes(4, "little", signed=True))
    theirs, ours = Wire(), Wire()
    Protocol2PacketHandler().writeTxOnly(theirs, 1, 116, 4, data)
    CheckedPacketHandler().writeTxOnly(ours, 1, 116, 4, data)
    assert theirs.sent.hex() == "fffffd00010900037400fffffdffcb05"
    assert ours.sent.hex() == "fffffd00010a00037400fffffdfdff23e5"


def test_a_port_in_use_is_busy() -> None:
    wire = Wire()
    wire.is_using = True
    assert CheckedPacketHandler().txPacket(wire, [0] * 10) == COMM_PORT_BUSY
    with pytest.raises(BusBusy):
        CheckedPacketHandler().send(wire, 1, Instruction.PING, b"")
