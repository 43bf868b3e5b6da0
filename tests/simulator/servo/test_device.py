"""Simulated servos on one bus: access rules, errors, service instructions, faults of the wire."""

import math

import pytest

from gripper.dynamixel.control_table import REGISTERS
from gripper.dynamixel.models import XC330_M288, XL330_M288, XM430_W350
from simulator.errors import PortUnplugged
from simulator.servo.bus import MemoryServoStream
from simulator.servo.protocol2 import Instruction, PacketParser, encode_instruction, encode_status

RANGE, LENGTH, LIMIT, ACCESS, UNKNOWN = 4, 5, 6, 7, 2


@pytest.mark.parametrize("model", [XM430_W350, XL330_M288, XC330_M288])
def test_factory_values(servo_bench, model):
    bench = servo_bench(model=model, settings={"baud_rate": 3})
    for name, value in model.factory_defaults.items():
        if name not in {"id", "baud_rate", "return_delay_time"}:
            register = REGISTERS[name]
            assert bench.read(1, register.address, register.size) == value, name
    assert bench.read(1, 100, 2) == 885
    assert bench.read(1, 102, 2) == model.current_limit_raw


@pytest.mark.parametrize(
    ("address", "size", "value", "error"),
    [
        (0, 2, 1, ACCESS),
        (71, 1, 0, ACCESS),
        (690, 1, 0, ACCESS),
        (65000, 2, 0, ACCESS),
        (117, 1, 0, LENGTH),
        (102, 2, -1193, 0),
        (102, 2, -1194, LIMIT),
        (104, 4, -351, LIMIT),
        (116, 4, 4095, 0),
        (116, 4, 4096, LIMIT),
        (116, 4, -1, LIMIT),
        (9, 1, 254, 0),
        (9, 1, 255, RANGE),
        (11, 1, 2, RANGE),
        (98, 1, -1, RANGE),
        (112, 4, 32767, 0),
        (112, 4, 32768, RANGE),
    ],
)
def test_what_a_write_is_answered(bench, address: int, size: int, value: int, error: int):
    before = bench.servos[0].core.table.data[:120]
    assert bench.write(1, address, size, value) == error
    after = bench.servos[0].core.table.data[:120]
    if error:
        assert after == before
    else:
        assert bench.read(1, address, size) == value % (1 << 8 * size)


@pytest.mark.parametrize(
    ("instruction", "parameters", "error"),
    [
        (Instruction.READ, "8400", LENGTH),
        (Instruction.WRITE, "7400", LENGTH),
        (Instruction.READ, "B902 0A00", ACCESS),
        (Instruction.READ, "4700 0100", ACCESS),
        (Instruction.READ, "8400 0000", ACCESS),
        (Instruction.FACTORY_RESET, "", LENGTH),
        (Instruction.FACTORY_RESET, "05", RANGE),
        (0x20, "01 4354524C", UNKNOWN),
    ],
)
def test_instructions_that_are_refused(bench, instruction: int, parameters: str, error: int):
    assert bench.ask(1, instruction, bytes.fromhex(parameters.replace(" ", ""))) == (error, b"")


def test_bytes_between_items_read_as_zero(bench):
    error, data = bench.ask(1, Instruction.READ, bytes((70, 0, 10, 0)))
    assert (error, data[1:6]) == (0, bytes(5))
    assert int.from_bytes(data[6:8], "little") == 1920


def test_one_bad_item_keeps_the_whole_block_from_being_written(bench):
    data = (200).to_bytes(2, "little") + (5000).to_bytes(2, "little")
    assert bench.ask(1, Instruction.WRITE, bytes((100, 0)) + data) == (LIMIT, b"")
    assert bench.read(1, 100, 2) == 885


def test_writing_the_mode_resets_gains_profiles_and_goals(bench):
    bench.write(1, 36, 2, 500)
    bench.write(1, 38, 2, 300)
    bench.write(1, 84, 2, 1)
    bench.write(1, 90, 2, 7)
    bench.write(1, 112, 4, 30)
    bench.write(1, 102, 2, 20)
    assert bench.write(1, 11, 1, 5) == 0
    assert bench.read(1, 84, 2) == 800
    assert bench.read(1, 90, 2) == 0
    assert bench.read(1, 112, 4) == 0
    assert bench.read(1, 36, 2) == bench.read(1, 100, 2) == 885
    assert bench.read(1, 102, 2) == 300


def test_the_pwm_limit_survives_other_modes(bench):
    bench.write(1, 36, 2, 500)
    assert bench.write(1, 11, 1, 16) == 0
    assert bench.read(1, 36, 2) == bench.read(1, 100, 2) == 500


def test_the_realtime_tick_counts_ms_and_wraps(bench):
    bench.clock.sleep(1.0)
    first = bench.read(1, 120, 2)
    bench.clock.sleep(0.25)
    assert 250 <= bench.read(1, 120, 2) - first < 290
    servo = bench.servos[0]
    assert servo.read(120, 2, 32.767).data == (32767).to_bytes(2, "little")
    assert servo.read(120, 2, 32.768).data == bytes(2)


def test_homing_offset_shifts_and_reverse_mirrors_only_the_motor(servo_bench):
    plain = servo_bench().read(1, 132, 4, signed=True)
    offset = servo_bench(settings={"homing_offset": 100, "operating_mode": 4})
    assert offset.read(1, 132, 4, signed=True) == plain + 100
    reverse = servo_bench(settings={"homing_offset": 100, "drive_mode": 1, "operating_mode": 4})
    assert reverse.read(1, 132, 4, signed=True) == (-plain) % 4096 + 100
    ignored = servo_bench(settings={"homing_offset": 2000, "operating_mode": 3})
    assert ignored.read(1, 132, 4, signed=True) == plain


def multi_turn(servo_bench):
    bench = servo_bench([1], settings={"operating_mode": 4})
    bench.motors[0].angle_rad += 3 * math.tau
    return bench


def test_extended_position_counts_turns_until_a_reboot(servo_bench):
    bench = multi_turn(servo_bench)
    before = bench.read(1, 132, 4, signed=True)
    assert before > 3 * 4096
    bench.ask(1, Instruction.REBOOT)
    bench.clock.sleep(0.5)
    assert bench.read(1, 132, 4, signed=True) == before - 3 * 4096


@pytest.mark.parametrize("entry", ["mode", "torque"])
def test_mode_3_falls_back_to_one_turn(servo_bench, entry: str):
    bench = multi_turn(servo_bench)
    bench.write(1, 11, 1, 3)
    if entry == "torque":
        bench.motors[0].angle_rad += math.tau
        assert bench.read(1, 132, 4, signed=True) > 4096
        bench.write(1, 64, 1, 1)
    assert 0 <= bench.read(1, 132, 4, signed=True) < 4096


def test_reboot_answers_first_then_is_deaf_and_loses_its_ram(bench):
    bench.write(1, 64, 1, 1)
    bench.write(1, 112, 4, 20)
    assert bench.ask(1, Instruction.REBOOT) == (0, b"")
    assert bench.exchange(encode_instruction(1, Instruction.PING)) == b""
    bench.clock.sleep(0.4)
    assert bench.read(1, 64, 1) == 0
    assert bench.read(1, 112, 4) == 0
    assert bench.read(1, 116, 4) == bench.read(1, 132, 4)
    assert bench.read(1, 120, 2) < 1000


def test_startup_configuration_switches_the_torque_on(servo_bench):
    bench = servo_bench(settings={"startup_configuration": 1})
    assert bench.read(1, 64, 1) == 1


def test_factory_reset_keeps_what_it_is_told_to(bench):
    bench.write(1, 31, 1, 60)
    assert bench.ask(1, Instruction.FACTORY_RESET, b"\x02") == (0, b"")
    bench.clock.sleep(0.5)
    assert bench.read(1, 31, 1) == 80
    assert bench.read(1, 9, 1) == 250
    bench.ask(2, Instruction.FACTORY_RESET, b"\x01")
    bench.clock.sleep(0.5)
    bench.device.baudrate = 57600
    assert bench.read(2, 8, 1) == 1
    servo = bench.servos[1]
    servo.execute(Instruction.FACTORY_RESET, b"\xff", bench.clock.monotonic())
    assert servo.servo_id == 1


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
