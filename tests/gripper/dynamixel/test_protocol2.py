"""Packets on the line: stuffing as the vendor describes it, and bounded waits."""

import pytest

from gripper.dynamixel.protocol2 import Instruction, PacketPort


def test_a_write_that_looks_like_a_header_is_stuffed(script, clock) -> None:
    script.expect("fffffd00010a00037400fffffdfdff23e5")
    port = PacketPort(script, clock, baudrate=1_000_000)
    port.send(1, Instruction.WRITE, b"\x74\x00" + (-131073).to_bytes(4, "little", signed=True))


def test_the_port_times_out_after_wire_delay_and_allowance(script, clock) -> None:
    port = PacketPort(script, clock, baudrate=1_000_000, return_delay_s=0.0005, allowance_s=0.001)
    script.expect("00" * 20)
    port.write(bytes(20))
    port.expect(30)
    assert port.read() == b""
    assert clock.monotonic() == pytest.approx(0.0005 + 0.0005 + 0.001)


def test_bytes_without_a_pause_are_read_for_one_longest_packet_more(script, clock) -> None:
    port = PacketPort(script, clock, baudrate=1_000_000, return_delay_s=0.0, allowance_s=0.001)
    script.chatter = b"\xa5"
    port.start_timeout(0.002)
    clock.sleep(0.05)
    while port.read():
        pass
    assert 0.010 < clock.monotonic() - 0.05 < 0.011
