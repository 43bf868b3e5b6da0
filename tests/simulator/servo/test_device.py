"""What one simulated servo answers: access rules, errors, modes, service instructions."""

import math

import pytest

from gripper.dynamixel.control_table import REGISTERS
from gripper.dynamixel.models import XC330_M288, XL330_M288, XM430_W350
from simulator.servo.protocol2 import Instruction, encode_instruction

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


@pytest.mark.parametrize(("level", "answered"), [(0, "p"), (1, "prs"), (2, "prsw")])
def test_status_return_level(bench, level: int, answered: str):
    bench.write(1, 68, 1, level)
    requests = {
        "p": encode_instruction(1, Instruction.PING),
        "r": encode_instruction(1, Instruction.READ, bytes((132, 0, 4, 0))),
        "s": encode_instruction(0xFE, Instruction.SYNC_READ, bytes((132, 0, 4, 0, 1))),
        "w": encode_instruction(1, Instruction.WRITE, bytes((65, 0, 1))),
    }
    assert "".join(key for key, raw in requests.items() if bench.exchange(raw)) == answered
    assert bench.servos[0].core.table.data[65] == 1


def test_the_secondary_id_is_obeyed_in_silence(bench):
    assert bench.write(1, 12, 1, 77) == 0
    raw = encode_instruction(77, Instruction.WRITE, bytes((65, 0, 1)))
    assert bench.exchange(raw) == b""
    assert bench.read(1, 65, 1) == 1


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
