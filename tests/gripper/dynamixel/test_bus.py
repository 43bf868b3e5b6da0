"""Exact exchanges: everything that is asked for and answered, byte by byte."""

from typing import Any

import pytest
from dynamixel_sdk import COMM_PORT_BUSY, Protocol2PacketHandler

from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    GOAL_CURRENT,
    HARDWARE_ERROR_STATUS,
    PRESENT_CURRENT,
    PRESENT_POSITION,
    RegisterBlock,
)
from gripper.dynamixel.protocol2 import CheckedPacketHandler, Instruction
from gripper.dynamixel.serial_port import SdkPort
from gripper.errors import BusBusy, BusCorrupt, BusTimeout, LimitExceeded, PortLost, ServoRejected
from simulator.cell import SimulatedCell
from simulator.servo.protocol2 import crc16

PING_1 = "FFFFFD00 01 0300 01 194E"
PONG_1 = "FFFFFD00 01 0700 55 00 060426 655D"
READ_132 = "FFFFFD00 01 0700 02 8400 0400 1D15"
IS_166 = "FFFFFD00 01 0800 55 00 A6000000 8CC0"
SYNC_132 = "FFFFFD00 FE 0900 82 8400 0400 01 02 CEFA"
TWO_IS_2079 = "FFFFFD00 02 0800 55 00 1F080000 BABE"
ACK = "FFFFFD00 01 0400 55 00 A10C"
REFUSED_1 = "FFFFFD00 01 0400 55 03 AB0C"


def packet(text: str) -> str:
    """Return a packet with its checksum, as it goes over the wire."""
    return text + crc16(bytes.fromhex(text)).to_bytes(2, "little").hex()


PING_2, PONG_2 = packet("FFFFFD00 02 0300 01"), "FFFFFD00 02 0700 55 00 060426 6F6D"
READ_132_2 = packet("FFFFFD00 02 0700 02 8400 0400")
ONE_IS_2079 = packet("FFFFFD00 01 0800 55 00 1F080000")


def test_stuffed_answer_is_sign_extended(script, bus) -> None:
    script.expect(
        "FFFFFD00 FE 0900 82 7E00 0A00 01 02 3892",
        "FFFFFD00 01 0F00 55 00 FFFFFDFDFFFFFF00080000 49F0",
        (0.0005, packet("FFFFFD00 02 0E00 55 00 0100 03000000 00100000")),
    )
    assert bus.sync_read([1, 2], RegisterBlock.between(PRESENT_CURRENT, PRESENT_POSITION)) == {
        1: {"present_current": -1, "present_velocity": -3, "present_position": 2048},
        2: {"present_current": 1, "present_velocity": 3, "present_position": 4096},
    }


def test_alert_accompanies_data_and_is_kept(script, bus) -> None:
    script.expect("FFFFFD00 01 0700 02 4600 0100 3CA3", "FFFFFD00 01 0500 55 80 20 9921")
    assert bus.read(1, HARDWARE_ERROR_STATUS) == 0x20
    assert bus.alerts == {1}
    script.expect(READ_132, IS_166)
    bus.read(1, PRESENT_POSITION)
    assert not bus.alerts


@pytest.mark.parametrize("error", ["01", "02", "04", "05", "06", "07"])
def test_an_error_status_is_an_error_and_never_data(script, bus, error: str) -> None:
    status = packet(f"FFFFFD00 01 0400 55 {error}")
    script.expect(READ_132, status)
    with pytest.raises(ServoRejected) as refused:
        bus.read(1, PRESENT_POSITION)
    assert (refused.value.code, refused.value.servo_id) == (int(error), 1)
    script.expect(SYNC_132, status, TWO_IS_2079)
    with pytest.raises(ServoRejected):
        bus.sync_read([1, 2], RegisterBlock(PRESENT_POSITION))


BAD_166 = "FFFFFD00 01 0800 55 00 A6000001 8CC0"
READS: dict[str, tuple[int, int, int, tuple[tuple[Any, ...], ...]]] = {
    "the servo received it damaged": (
        *(166, 0, 0),
        ((READ_132, REFUSED_1), (PING_1, PONG_1), (READ_132, IS_166)),
    ),
    "the servo is slow": (
        *(166, 0, 0),
        ((READ_132,), (PING_1, (0.03, PONG_1)), (READ_132, (0.03, IS_166))),
    ),
    "a ping overtakes a late answer": (
        *(2079, 1, 0),
        ((READ_132, (0.03, IS_166)), (PING_1, (3e-4, PONG_1)), (READ_132, (3e-4, ONE_IS_2079))),
    ),
    "late by less than the ping": (
        *(2079, 1, 0),
        ((READ_132, (0.0028, IS_166)), (PING_1, (8e-4, PONG_1)), (READ_132, (3e-4, ONE_IS_2079))),
    ),
    "damaged, foreign and short answers": (
        *(166, 2, 1),
        ((READ_132, BAD_166, TWO_IS_2079, ACK, IS_166),),
    ),
    "foreign and short answers": (166, 2, 0, ((READ_132, TWO_IS_2079, ACK, IS_166),)),
    "own echo": (166, 0, 1, ((READ_132, READ_132, (0.0003, IS_166)),)),
    "no error byte": (166, 0, 1, ((READ_132, packet("FFFFFD00 01 0300 55"), IS_166),)),
    "bytes before it": (166, 0, 1, ((READ_132, "A55A" + IS_166),)),
}
"""Answers that do not come as they should: what is read, late and damaged ones, the exchanges."""


@pytest.mark.parametrize("case", READS)
def test_a_read_gets_its_own_answer_if_need_be_behind_a_ping(script, bus, case: str) -> None:
    raw, late, corrupt, exchanges = READS[case]
    for exchange in exchanges:
        script.expect(*exchange)
    assert bus.read(1, PRESENT_POSITION) == raw
    statistics = bus.statistics
    counted = statistics.late, statistics.corrupt, statistics.retries
    assert counted == (late, corrupt, len(exchanges) // 2)


@pytest.mark.parametrize("damaged", [True, False])
def test_lost_answers_of_a_sync_read_cost_less_than_a_period(script, bus, clock, damaged) -> None:
    bus.port.return_delay_s = 0.0
    if damaged:
        script.expect(SYNC_132, (0.0003, REFUSED_1), (0.0006, packet("FFFFFD00 02 0400 55 03")))
        script.expect(PING_1, (0.0003, PONG_1))
        script.expect(READ_132, (0.0003, IS_166))
    else:
        script.expect(SYNC_132, (0.0003, IS_166))
    script.expect(PING_2, (0.0003, PONG_2))
    script.expect(READ_132_2, (0.0003, TWO_IS_2079))
    with bus.in_loop():
        read = bus.sync_read([1, 2], RegisterBlock(PRESENT_POSITION))
    assert [read[i]["present_position"] for i in (1, 2)] == [166, 2079]
    assert not any(bus.misses.values())
    assert clock.monotonic() < 0.004


def time_out(script, bus, *answers) -> None:
    """Read in the loop without an answer in time, and without one to the ping."""
    script.expect(READ_132, *answers)
    script.expect(PING_1)
    with bus.in_loop(), pytest.raises(BusTimeout, match="no answer of servo 1: check"):
        bus.read(1, PRESENT_POSITION)


def test_a_silent_servo_is_a_timeout_within_a_bounded_time(script, bus, clock) -> None:
    time_out(script, bus)
    assert clock.monotonic() < 0.006
    assert bus.misses[1] == bus.statistics.timeouts == 2
    assert isinstance(BusTimeout("x"), TimeoutError)


def test_outside_of_the_loop_a_silent_servo_gets_three_pings(script, bus, clock) -> None:
    script.expect(READ_132)
    for _ in range(3):
        script.expect(PING_1)
    with pytest.raises(BusTimeout):
        bus.read(1, PRESENT_POSITION)
    assert clock.monotonic() < 0.16


def test_no_time_left_in_the_period_means_no_retry(script, clock) -> None:
    bus = ServoBus(script, baudrate=1_000_000, clock=clock, period_s=0.001)
    script.expect(SYNC_132)
    with bus.in_loop(), pytest.raises(BusTimeout):
        bus.sync_read([1, 2], RegisterBlock(PRESENT_POSITION))


def test_a_late_answer_is_never_taken_for_the_next_one(script, bus) -> None:
    time_out(script, bus, (0.030, IS_166))
    script.expect(SYNC_132, (0.0002, ONE_IS_2079), (0.0003, TWO_IS_2079))
    assert bus.sync_read([1, 2], RegisterBlock(PRESENT_POSITION))[1]["present_position"] == 2079
    assert bus.statistics.late == 1


def test_the_line_is_quiet_before_the_next_request_after_a_failure(script, bus, clock) -> None:
    time_out(script, bus)
    before_s = clock.monotonic()
    script.expect(READ_132, IS_166)
    assert bus.read(1, PRESENT_POSITION) == 166
    assert clock.monotonic() - before_s >= 0.05
    before_s = clock.monotonic()
    bus.expect_late_answer()
    script.expect(READ_132, IS_166)
    assert bus.read(1, PRESENT_POSITION) == 166
    assert clock.monotonic() - before_s >= 0.05


def test_noise_in_the_wait_for_a_quiet_line_counts_from_when_it_came(script, bus, clock) -> None:
    time_out(script, bus, (0.01, "A5"))
    script.expect(READ_132, IS_166)
    assert bus.read(1, PRESENT_POSITION) == 166
    assert clock.monotonic() < 0.08


def test_a_line_that_never_falls_quiet_is_named_with_what_was_heard(script, bus, clock) -> None:
    time_out(script, bus)
    script.chatter = b"\xa5\x5a"
    before_s = clock.monotonic()
    with pytest.raises(BusCorrupt, match=r"within 0\.5 s: .* \d{3,} bytes .* a5 5a a5 5a.*noise"):
        bus.read(1, PRESENT_POSITION)
    assert 0.5 <= clock.monotonic() - before_s < 0.6
    script.chatter = b""
    script.expect(READ_132, IS_166)
    assert bus.read(1, PRESENT_POSITION) == 166


@pytest.mark.parametrize(
    ("answers", "chatter"), [([BAD_166, TWO_IS_2079], b""), ([ACK], b""), ([], b"\xff\xff")]
)
def test_damage_ends_a_transaction_in_bounded_time(script, bus, clock, answers, chatter) -> None:
    script.expect(READ_132, *answers)
    script.expect(PING_1)
    script.chatter = chatter
    with bus.in_loop(), pytest.raises(BusCorrupt, match="damaged"):
        bus.read(1, PRESENT_POSITION)
    assert clock.monotonic() < 0.03
    assert bus.statistics.corrupt == (2 if chatter else 1)


def test_a_reboot_is_sent_once(script, bus) -> None:
    script.expect("FFFFFD00 01 0300 08 2F4E")
    with pytest.raises(BusTimeout):
        bus.reboot(1)


def test_wrong_use_is_refused_before_anything_is_sent(bus) -> None:
    with pytest.raises(LimitExceeded, match="read-only"):
        bus.write(1, PRESENT_POSITION, 0)
    with pytest.raises(LimitExceeded, match="fit"):
        bus.write(1, GOAL_CURRENT, 40000)
    with pytest.raises(LimitExceeded, match="ID 253"):
        bus.ping(253)


def test_a_closed_bus_is_lost(script, bus) -> None:
    bus.close()
    assert script.closed
    with pytest.raises(PortLost, match="closed"):
        bus.ping(1)


def test_an_answer_that_came_while_the_program_stood_still_is_taken(
    script, bus, clock, monkeypatch
) -> None:
    """The machine gives the program no time between request and answer."""
    port = bus.port
    start = port.start_timeout

    def stall(duration_s: float) -> None:
        start(duration_s)
        clock.sleep(0.057)

    monkeypatch.setattr(port, "start_timeout", stall)
    for _ in range(3):
        script.expect(SYNC_132, (0.0002, IS_166), (0.0004, TWO_IS_2079))
        with bus.in_loop():
            read = bus.sync_read([1, 2], RegisterBlock(PRESENT_POSITION))
        assert read == {1: {"present_position": 166}, 2: {"present_position": 2079}}
    script.expect(READ_132, IS_166)
    assert bus.read(1, PRESENT_POSITION) == 166
    assert (bus.statistics.timeouts, bus.statistics.retries) == (0, 0)


def test_factory_new_servos_share_an_id_and_are_found_to() -> None:
    cell = SimulatedCell()
    for number in (1, 2):
        cell.inject(f"servo{number}.factory")
    cell.clock.sleep(0.5)
    for baudrate, ids in ((1_000_000, []), (57600, [1])):
        cell.devices.servo_bus.baudrate = baudrate
        bus = ServoBus(cell.open_servo_port(), baudrate=baudrate, clock=cell.clock)
        present, damaged = bus.scan_at_once()
        assert ([one.servo_id for one in present], damaged) == (ids, False)
    assert bus.shares_id(1)
    cell.inject("servo2.off")
    assert not bus.shares_id(1)
    cell.inject("servos.lose_next=1")
    assert not bus.shares_id(1)
    cell.inject("servos.lose_next=3")
    assert bus.shares_id(1)
    cell.devices.servo_bus.servos[0].registers.put("status_return_level", 0)
    assert not bus.shares_id(1)


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
