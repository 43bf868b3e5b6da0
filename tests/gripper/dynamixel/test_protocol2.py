import pytest
from dynamixel_sdk import COMM_PORT_BUSY, Protocol2PacketHandler

from gripper.dynamixel.protocol2 import CheckedPacketHandler, Instruction
from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import BusBusy
from simulator.servo.protocol2 import crc16


def with_crc(text: str) -> bytes:
    start = bytes.fromhex(text)
    return start + crc16(start).to_bytes(2, "little")


@pytest.mark.parametrize(
    ("data", "packet"),
    [
        ("FFFFFD00010B005500FFFFFDFDFFFDFD5460", "fffffdfffdfd"),
        ("FFFFFD0001040055", None),
        ("FFFFFDFD", None),
        ("AA", None),
        ("FFFFFD0001E80355", None),
        ("FFFFFD00010110", None),
        (with_crc("FFFFFD0001030055").hex(), None),
    ],
)
def test_a_packet_is_found_whole_or_not_at_all(
    script, clock, data: str, packet: str | None
) -> None:
    port, handler = SdkPort(script, clock), CheckedPacketHandler()
    wire, good = bytes.fromhex(data), with_crc("FFFFFD00020500550077")
    script.arriving = [(0.0, wire + good)]
    port.start_timeout(0.001)
    status = handler.receive(port)
    if packet is not None:
        assert (status.servo_id, status.data.hex(), handler.dropped) == (1, packet, b"")
        status, wire = handler.receive(port), b""
    assert (status.servo_id, status.data, handler.dropped) == (2, b"\x77", wire)
    assert handler.receive(port) is None


def test_the_sdk_itself_sends_the_stuffed_write_wrongly_and_ours_rightly(script, clock) -> None:
    data = list((-131073).to_bytes(4, "little", signed=True))
    script.expect("fffffd00010900037400fffffdffcb05").expect("fffffd00010a00037400fffffdfdff23e5")
    for handler in (Protocol2PacketHandler(), CheckedPacketHandler()):
        handler.writeTxOnly(SdkPort(script, clock), 1, 116, 4, data)


def test_a_port_in_use_is_busy(script, clock) -> None:
    port = SdkPort(script, clock)
    port.is_using = True
    assert CheckedPacketHandler().txPacket(port, [0] * 10) == COMM_PORT_BUSY
    with pytest.raises(BusBusy):
        CheckedPacketHandler().send(port, 1, Instruction.PING, b"")
