"""Several servos on one bus: broadcasts, chains of answers, wire time, faults of the wire."""

import pytest

from simulator.errors import PortUnplugged
from simulator.servo.bus import MemoryServoStream
from simulator.servo.faults import Chatter
from simulator.servo.protocol2 import Instruction, PacketParser, encode_instruction, encode_status


def ids(answer: bytes) -> list[int]:
    return [p.packet_id for p in PacketParser().push(answer) if p.intact]


def sync_read(address: int, size: int, *servo_ids: int) -> bytes:
    parameters = address.to_bytes(2, "little") + size.to_bytes(2, "little") + bytes(servo_ids)
    return encode_instruction(0xFE, Instruction.SYNC_READ, parameters)


@pytest.mark.parametrize(
    ("instruction", "parameters", "led"),
    [(Instruction.READ, "8400 0400", 0), (Instruction.WRITE, "4100 01", 1)],
)
def test_broadcasts_reach_all_and_are_not_acknowledged(bench, instruction, parameters, led):
    assert bench.exchange(encode_instruction(0xFE, instruction, bytes.fromhex(parameters))) == b""
    assert [bench.read(i, 65, 1) for i in (1, 2)] == [led, led]


@pytest.mark.parametrize(
    ("instruction", "parameters"),
    [
        (Instruction.SYNC_WRITE, "4100 0100 01 01 02"),
        (Instruction.SYNC_WRITE, "4100"),
        (Instruction.SYNC_WRITE, "4100 0000 01"),
        (Instruction.BULK_WRITE, "01 4100 0200 01"),
        (Instruction.BULK_WRITE, "01 4100"),
        (Instruction.SYNC_READ, "8400 0400"),
        (Instruction.BULK_READ, "01 9000 02"),
    ],
)
def test_group_instructions_cut_off_are_passed_over(bench, instruction: int, parameters: str):
    assert bench.exchange(encode_instruction(0xFE, instruction, bytes.fromhex(parameters))) == b""
    assert [bench.read(i, 65, 1) for i in (1, 2)] == [0, 0]


# Wire time


def round_trip_s(bench, request: bytes) -> float:
    start_s = bench.clock.monotonic()
    bench.stream.write(request)
    due_s = start_s
    while bench.stream.read(256, 0.02):
        due_s = bench.clock.monotonic()
    return due_s - start_s


def test_slow_lines_and_return_delay_add_up(servo_bench):
    bench = servo_bench(baudrate=57600, settings={"baud_rate": 1, "return_delay_time": 250})
    expected_s = (16 + 2 * 21) * 10 / 57600 + 2 * 500e-6
    assert round_trip_s(bench, sync_read(126, 10, 1, 2)) == pytest.approx(expected_s)


# Faults of the wire


PING = encode_instruction(1, Instruction.PING)
PONG = encode_status(1, 0, bytes((0xFC, 0x03, 48)))


def test_the_echo_of_the_host_comes_before_no_answer_of_a_silent_servo(bench):
    bench.device.faults.silent.add(1)
    bench.device.faults.echo = True
    assert bench.exchange(PING) == PING


@pytest.mark.parametrize(
    ("knob", "expected"),
    [
        ("drop", b""),
        ("lose_request", b""),
        ("truncate", PONG[:-3]),
        ("garbage", b"\xaa\xff\xff\xfd\x55" + PONG),
        ("wrong_id", encode_status(2, 0, PONG[9:-2])),
    ],
)
def test_a_knob_hits_packets_while_it_is_on(bench, knob: str, expected: bytes):
    setattr(bench.device.faults, knob, 1.0)
    assert bench.exchange(PING) == expected
    setattr(bench.device.faults, knob, 0.0)
    assert bench.exchange(PING) == PONG


def test_the_next_answers_are_lost(bench):
    bench.device.faults.drop_next = 2
    assert [bench.exchange(PING, 0.001) for _ in range(3)] == [b"", b"", PONG]


def test_a_bit_flip_changes_one_bit(bench):
    bench.device.faults.bit_flip = 1.0
    answer = bench.exchange(PING)
    difference = int.from_bytes(answer, "big") ^ int.from_bytes(PONG, "big")
    assert difference.bit_count() == 1


def test_chances_are_the_same_with_the_same_seed(servo_bench):
    def lost(seed: int) -> list[int]:
        bench = servo_bench()
        bench.device.faults.seed = seed
        bench.device.faults.drop = 0.3
        return [i for i in range(60) if not bench.exchange(PING, 0.001)]

    assert lost(1) == lost(1) != lost(2)
    assert 8 <= len(lost(1)) <= 30


def test_each_answer_comes_again_later(bench):
    bench.device.faults.repeat_s = 0.0095
    assert bench.exchange(PING, 0.005) == PONG
    assert bench.exchange(b"", 0.002) == b""
    assert bench.exchange(b"", 0.005) == PONG
    assert bench.exchange(b"", 0.02) == b""


def test_a_lagging_answer_is_that_to_the_request_of_its_kind_before(bench):
    bench.device.faults.lag = True
    bench.servos[0].core.table.data[65] = 1
    assert bench.exchange(read(65, 1))[9] == 1
    bench.servos[0].core.table.data[65] = 2
    assert bench.exchange(PING) == PONG
    assert bench.exchange(read(65, 1))[9] == 1
    assert bench.exchange(read(65, 1))[9] == 2


def read(address: int, size: int) -> bytes:
    return encode_instruction(1, Instruction.READ, bytes((address, 0, size, 0)))


def test_chatter_comes_by_itself_and_into_answers(bench):
    bench.device.faults.chatter = Chatter(data=b"\xa5", every_s=0.001)
    heard = b""
    start_s = bench.clock.monotonic()
    while bench.clock.monotonic() < start_s + 0.02:
        heard += bench.stream.read(64, 0.02)
    assert set(heard) == {0xA5}
    assert 19 <= len(heard) <= 21
    bench.device.faults.chatter = Chatter(data=b"\xa5", every_s=0.00005)
    bench.stream.write(PING)
    heard = b""
    start_s = bench.clock.monotonic()
    while bench.clock.monotonic() < start_s + 0.003:
        heard += bench.stream.read(64, 0.001)
    assert PONG not in heard
    assert heard.replace(b"\xa5", b"") == PONG
    bench.device.faults.chatter = None
    assert bench.exchange(PING)[-len(PONG) :] == PONG


def test_an_adapter_that_loses_its_supply_forgets_half_a_packet(bench):
    bench.device.receive(PING[:6], 0.0)
    bench.device.drop_pending()
    bench.device.receive(PING[6:], 0.0)
    assert bench.device.next_event_s() is None


def test_servos_with_the_same_id_answer_at_once(bench):
    second = bench.device.servos[1]
    second.core.registers.put("id", 1)
    ping = encode_instruction(1, Instruction.PING)
    assert ids(bench.exchange(ping)) == [1]
    assert ids(bench.exchange(encode_instruction(0xFE, Instruction.PING))) == [1]
    second.core.registers.put("moving_threshold", 77)
    read = encode_instruction(1, Instruction.READ, bytes.fromhex("1800 0400"))
    answer = bench.exchange(read)
    assert answer
    assert ids(answer) == []
    bench.device.faults.silent.add(2)
    assert ids(bench.exchange(read)) == [1]


# The stream in memory


def test_unplugged_and_plugged_in_again(bench):
    bench.device.faults.unplugged = True
    for use in (
        lambda: bench.stream.write(PING),
        lambda: bench.stream.read(1, 0.1),
        bench.stream.drop_input,
    ):
        with pytest.raises(PortUnplugged, match="cable"):
            use()
    bench.device.receive(PING, bench.clock.monotonic())
    assert bench.device.transmit(bench.clock.monotonic() + 1.0) == b""
    bench.device.faults.unplugged = False
    with pytest.raises(PortUnplugged, match="open the port again"):
        bench.stream.write(PING)
    bench.stream = MemoryServoStream(bench.device, bench.clock)
    assert len(bench.exchange(PING)) == 14


def test_unplugging_ends_a_read_that_waits(bench):
    def unplug(now_s: float) -> None:
        bench.device.faults.unplugged = now_s > 0.005

    bench.clock.on_advance.append(unplug)
    bench.device.faults.delay_s = 0.04
    bench.stream.write(PING)
    with pytest.raises(PortUnplugged):
        bench.stream.read(10, 0.1)
    assert bench.clock.monotonic() < 0.05
