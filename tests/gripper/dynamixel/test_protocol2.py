import pytest
from dynamixel_sdk import COMM_PORT_BUSY, Protocol2PacketHandler

from gripper.dynamixel.protocol2 import CheckedPacketHandler, Instruction
from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import BusBusy


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
