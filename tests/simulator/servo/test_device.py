"""Simulated servos on one bus: access rules, errors, service instructions, faults of the wire."""

import math
from operator import attrgetter

import pytest

from gripper.dynamixel.control_table import REGISTERS
from gripper.dynamixel.models import XC330_M288, XL330_M288, XM430_W350, OperatingMode
from simulator.errors import PortUnplugged
from simulator.servo.bus import MemoryServoStream
from simulator.servo.device import WatchdogStop
from simulator.servo.protocol2 import Instruction, encode_status
from tests.simulator.conftest import ServoBench, encode_instruction

RANGE, LENGTH, LIMIT, ACCESS = 4, 5, 6, 7


@pytest.mark.parametrize("model", [XM430_W350, XL330_M288, XC330_M288])
def test_factory_values(model):
    bench = ServoBench(model=model, settings={"baud_rate": 3})
    for name, value in model.factory_defaults.items():
        if name not in {"id", "baud_rate", "return_delay_time"}:
            register = REGISTERS[name]
            assert bench.read(1, register.address, register.size) == value, name
    assert bench.get(1, "goal_pwm") == 885
    assert bench.get(1, "goal_current") == model.current_limit_raw


@pytest.mark.parametrize(
    ("address", "size", "value", "error"),
    [
        (690, 1, 0, ACCESS),
        (117, 1, 0, LENGTH),
        (102, 2, -1193, 0),
        (102, 2, -1194, LIMIT),
        (104, 4, -351, LIMIT),
        (116, 4, 4095, 0),
        (116, 4, 4096, LIMIT),
        (116, 4, -1, LIMIT),
        (11, 1, 2, RANGE),
        (98, 1, -1, RANGE),
        (112, 4, 32767, 0),
        (112, 4, 32768, RANGE),
    ],
)
def test_what_a_write_is_answered(bench, address: int, size: int, value: int, error: int):
    before = bench.servos[0].registers.data[:120]
    assert bench.write(1, address, size, value) == error
    if error:
        assert bench.servos[0].registers.data[:120] == before
    else:
        assert bench.read(1, address, size) == value % (1 << 8 * size)


@pytest.mark.parametrize(
    ("instruction", "parameters", "error"),
    [
        (Instruction.READ, "8400", LENGTH),
        (Instruction.WRITE, "7400", LENGTH),
        (Instruction.READ, "B902 0A00", ACCESS),
        (Instruction.READ, "8400 0000", ACCESS),
        (0x06, "01", 2),  # factory reset
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
    assert bench.get(1, "goal_pwm") == 885


def test_writing_the_mode_resets_gains_profiles_and_goals(bench):
    bench.put(1, pwm_limit=500, current_limit=300, position_p_gain=1, feedforward_1st_gain=7)
    bench.put(1, profile_velocity=30, goal_current=20, operating_mode=5)
    gains = bench.gets(1, "position_p_gain", "feedforward_1st_gain", "profile_velocity")
    assert gains == [800, 0, 0]
    assert bench.gets(1, "pwm_limit", "goal_pwm", "goal_current") == [885, 885, 300]
    bench.put(1, pwm_limit=500, operating_mode=16)
    assert bench.gets(1, "pwm_limit", "goal_pwm") == [500, 500]


@pytest.mark.parametrize(
    ("model", "gains"),
    [(XM430_W350, (4000, 0, 800)), (XL330_M288, (0, 0, 400)), (XC330_M288, (500, 0, 1100))],
)
def test_a_change_to_mode_5_loads_its_gains(model, gains):
    bench = ServoBench([1], model=model)
    names = [f"position_{letter}_gain" for letter in "dip"]
    plain = [0 if model is XM430_W350 else gains[0], *gains[1:]]
    assert bench.gets(1, *names) == plain
    bench.put(1, operating_mode=5)
    assert bench.gets(1, *names) == [*gains]
    bench.put(1, operating_mode=3)
    assert bench.gets(1, *names) == plain


@pytest.mark.parametrize(("model", "error"), [(XM430_W350, ACCESS), (XL330_M288, 0)])
def test_only_the_330_size_has_a_pwm_slope(model, error):
    bench = ServoBench([1], model=model)
    assert bench.write(1, 62, 1, 70) == error
    if not error:
        bench.put(1, torque_enable=1)
        assert bench.motors[0].command.slope_raw == 70


def test_the_realtime_tick_counts_ms_and_wraps(bench):
    bench.clock.sleep(1.0)
    first = bench.get(1, "realtime_tick")
    bench.clock.sleep(0.25)
    assert 250 <= bench.get(1, "realtime_tick") - first < 290
    servo = bench.servos[0]
    assert servo.read(120, 2, 32.767).data == (32767).to_bytes(2, "little")
    assert servo.read(120, 2, 32.768).data == bytes(2)


def test_reverse_mode_mirrors_position_and_motion():
    plain = ServoBench().get(1, "present_position")
    reverse = ServoBench(settings={"drive_mode": 1, "operating_mode": 4})
    assert reverse.get(1, "present_position") == (-plain) % 4096
    reverse.put(1, operating_mode=1, torque_enable=1, goal_velocity=40)
    reverse.clock.sleep(0.1)
    assert reverse.motors[0].velocity_rad_s < 0.0
    assert reverse.get(1, "present_velocity") == pytest.approx(40, abs=4)


def multi_turn():
    bench = ServoBench([1], settings={"operating_mode": 4})
    bench.motors[0].angle_rad += 3 * math.tau
    return bench


def test_extended_position_counts_turns_until_a_reboot():
    bench = multi_turn()
    before = bench.get(1, "present_position")
    assert before > 3 * 4096
    bench.ask(1, Instruction.REBOOT)
    bench.clock.sleep(0.5)
    assert bench.get(1, "present_position") == before - 3 * 4096


@pytest.mark.parametrize("entry", ["mode", "torque"])
def test_mode_3_falls_back_to_one_turn(entry: str):
    bench = multi_turn()
    bench.put(1, operating_mode=3)
    if entry == "torque":
        bench.motors[0].angle_rad += math.tau
        assert bench.get(1, "present_position") > 4096
        bench.put(1, torque_enable=1)
    assert 0 <= bench.get(1, "present_position") < 4096


def test_reboot_answers_first_then_is_deaf_and_loses_its_ram(bench):
    bench.put(1, torque_enable=1, profile_velocity=20)
    assert bench.ask(1, Instruction.REBOOT) == (0, b"")
    assert bench.exchange(encode_instruction(1, Instruction.PING)) == b""
    bench.clock.sleep(0.4)
    assert bench.gets(1, "torque_enable", "profile_velocity") == [0, 0]
    assert bench.get(1, "goal_position") == bench.get(1, "present_position")
    assert bench.get(1, "realtime_tick") < 1000


@pytest.mark.parametrize(
    ("instruction", "parameters", "led"),
    [(Instruction.READ, "8400 0400", 0), (Instruction.WRITE, "4100 01", 1)],
)
def test_broadcasts_reach_all_and_are_not_acknowledged(bench, instruction, parameters, led):
    assert bench.exchange(encode_instruction(0xFE, instruction, bytes.fromhex(parameters))) == b""
    assert [bench.get(i, "led") for i in (1, 2)] == [led, led]


@pytest.mark.parametrize(
    ("instruction", "parameters"),
    [
        (Instruction.SYNC_WRITE, "4100 0100 01 01 02"),
        (Instruction.SYNC_WRITE, "4100"),
        (Instruction.SYNC_WRITE, "4100 0000 01"),
        (Instruction.SYNC_READ, "8400 0400"),
    ],
)
def test_group_instructions_cut_off_are_passed_over(bench, instruction: int, parameters: str):
    assert bench.exchange(encode_instruction(0xFE, instruction, bytes.fromhex(parameters))) == b""
    assert [bench.get(i, "led") for i in (1, 2)] == [0, 0]


# Wire time


def test_slow_lines_and_return_delay_add_up():
    bench = ServoBench(baudrate=57600, settings={"baud_rate": 1, "return_delay_time": 250})
    expected_s = (16 + 2 * 21) * 10 / 57600 + 2 * 500e-6
    start_s = bench.clock.monotonic()
    asked = bytes((126, 0, 10, 0, 1, 2))
    bench.stream.write(encode_instruction(0xFE, Instruction.SYNC_READ, asked))
    while bench.stream.read(256, 0.02):
        end_s = bench.clock.monotonic()
    assert end_s - start_s == pytest.approx(expected_s)


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


def test_chances_are_the_same_with_the_same_seed():
    def lost(seed: int) -> list[int]:
        bench = ServoBench()
        bench.device.faults.rng.seed(seed)
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
    bench.servos[0].registers.data[65] = 1
    assert bench.exchange(read(65, 1))[9] == 1
    bench.servos[0].registers.data[65] = 2
    assert bench.exchange(PING) == PONG
    assert bench.exchange(read(65, 1))[9] == 1
    assert bench.exchange(read(65, 1))[9] == 2


def read(address: int, size: int) -> bytes:
    return encode_instruction(1, Instruction.READ, bytes((address, 0, size, 0)))


def test_an_adapter_that_loses_its_supply_forgets_half_a_packet(bench):
    bench.device.receive(PING[:6], 0.0)
    bench.device.drop_pending()
    bench.device.receive(PING[6:], 0.0)
    assert bench.device.next_event_s() == math.inf


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


# -- Modes, watchdog and protections: what the servo does to its motor -----------------------------


ALERT = 0x80


@pytest.fixture
def closing():
    """Return a bench in mode 5 that presses both fingers on a wall with 100 counts of current."""

    def make(watchdog_stop: WatchdogStop = WatchdogStop.HOLD):
        pressing = ServoBench(settings={"operating_mode": 5})
        for servo in pressing.servos:
            servo.watchdog_stop = watchdog_stop
        pressing.clock.sleep(0.01)
        for servo_id in (1, 2):
            present = pressing.get(servo_id, "present_position")
            pressing.put(servo_id, goal_position=present, goal_current=100, torque_enable=1)
            pressing.put(servo_id, goal_position=2048)
        pressing.forces_n = (9.0, 9.0)
        return pressing

    return make


@pytest.fixture
def pressing(closing):
    return closing()


def test_position_mode_reaches_its_goal_and_says_so():
    pressing = ServoBench()
    goal = pressing.get(1, "present_position") - 300
    pressing.put(1, profile_velocity=100, torque_enable=1, goal_position=goal)
    pressing.clock.sleep(0.05)
    assert pressing.gets(1, "moving", "moving_status") == [1, 0x32]
    assert pressing.get(1, "present_velocity") < -50
    pressing.clock.sleep(1.5)
    assert pressing.get(1, "present_position") == pytest.approx(goal, abs=12)
    assert pressing.gets(1, "moving", "moving_status", "position_trajectory") == [0, 0x31, goal]


@pytest.mark.parametrize(
    ("mode", "quantity", "goal"), [(0, "current", -80), (1, "velocity", -40), (16, "pwm", -200)]
)
def test_current_velocity_and_pwm_modes(mode, quantity, goal):
    pressing = ServoBench(settings={"operating_mode": mode})
    pressing.put(1, **{f"goal_{quantity}": 0}, torque_enable=1)
    pressing.put(1, **{f"goal_{quantity}": goal})
    pressing.clock.sleep(0.2)
    assert pressing.get(1, f"present_{quantity}") == pytest.approx(goal, abs=3)
    assert pressing.motors[0].velocity_rad_s < 0.0


@pytest.mark.parametrize(("mode", "quantity", "limit"), [(0, "current", 90), (16, "pwm", 300)])
def test_a_limit_lowered_afterwards_bounds_the_goal(mode, quantity, limit):
    pressing = ServoBench(settings={"operating_mode": mode})
    pressing.put(1, **{f"goal_{quantity}": -700, f"{quantity}_limit": limit}, torque_enable=1)
    pressing.clock.sleep(0.05)
    assert pressing.get(1, f"present_{quantity}") == pytest.approx(-limit, abs=2)


def test_the_gains_reach_the_motor():
    pressing = ServoBench(model=XC330_M288, settings={"operating_mode": 5})
    pressing.put(1, torque_enable=1)
    gains = attrgetter("command.p_gain", "command.d_gain")
    assert gains(pressing.motors[0]) == (1100, 500)
    pressing.put(1, position_d_gain=700, position_p_gain=900)
    assert gains(pressing.motors[0]) == (900, 700)
    pressing.put(1, bus_watchdog=1)
    pressing.clock.sleep(0.05)
    assert gains(pressing.motors[0]) == (900, 700)


@pytest.mark.parametrize(("model", "obeyed"), [(XM430_W350, 1), (XL330_M288, 0)])
def test_the_profile_reaches_the_motor_but_not_in_mode_5_of_the_330_size(model, obeyed: int):
    pressing = ServoBench(model=model, settings={"operating_mode": 5})
    pressing.put(1, profile_velocity=40, profile_acceleration=20, torque_enable=1)
    pressing.put(1, goal_position=2048)
    command = pressing.motors[0].command
    assert command.profile_velocity_rad_s == obeyed * 40 * XM430_W350.velocity_unit_rad_s
    assert command.profile_acceleration_rad_s2 == obeyed * 20 * XM430_W350.acceleration_unit_rad_s2


# Bus watchdog


def test_any_packet_feeds_the_watchdog(pressing):
    pressing.put(1, bus_watchdog=5)
    for _ in range(10):
        pressing.clock.sleep(0.07)
        pressing.stream.write(encode_instruction(200, Instruction.PING))
    assert pressing.get(1, "bus_watchdog") == 5


def test_a_damaged_packet_does_not_feed_the_watchdog(pressing):
    pressing.put(1, bus_watchdog=2)
    bad = bytearray(encode_instruction(200, Instruction.PING))
    bad[-1] ^= 1
    pressing.clock.sleep(0.03)
    pressing.stream.write(bytes(bad))
    pressing.clock.sleep(0.03)
    assert pressing.get(1, "bus_watchdog") == -1


def trip(pressing):
    pressing.clock.sleep(0.3)
    pressing.put(1, bus_watchdog=5)
    pressing.clock.sleep(0.11)
    assert pressing.servos[0].watchdog_tripped


def test_a_trip_holds_the_present_position(pressing):
    trip(pressing)
    command = pressing.motors[0].command
    assert command.mode is OperatingMode.CURRENT_BASED_POSITION
    assert command.current_a == pytest.approx(0.269)
    held = pressing.motors[0].angle_rad
    pressing.forces_n = (0.0, 0.0)
    pressing.clock.sleep(0.5)
    assert pressing.motors[0].angle_rad == pytest.approx(held, abs=0.03)


@pytest.mark.parametrize(
    ("stop", "current"), [(WatchdogStop.ZERO_CURRENT, 0), (WatchdogStop.KEEPS_TURNING, -99)]
)
def test_a_trip_can_leave_the_motor_without_current_or_turning(closing, stop, current):
    pressing = closing(stop)
    trip(pressing)
    pressing.clock.sleep(0.05)
    assert pressing.gets(1, "present_current", "torque_enable") == [current, 1]
    assert pressing.write(1, 102, 2, 0) == RANGE


def test_a_cleared_motor_waits_for_a_goal(pressing):
    trip(pressing)
    stopped = pressing.motors[0].command
    pressing.put(1, bus_watchdog=0, profile_velocity=10)
    assert pressing.motors[0].command == stopped
    pressing.put(1, goal_position=2048)
    assert pressing.motors[0].command != stopped


# Protections


@pytest.mark.parametrize(
    ("provoke", "bits"),
    [
        (lambda core: core.plant.overload(), 0x20),
        (lambda core: setattr(core.plant, "temperature_c", 95.0), 0x04),
        (lambda core: setattr(core, "injected_error", 0x10), 0x10),
    ],
    ids=["overload", "overheating", "shock"],
)
def test_a_latched_error_drops_the_torque_until_a_reboot(pressing, provoke, bits: int):
    pressing.clock.sleep(0.1)
    provoke(pressing.servos[0])
    pressing.clock.sleep(0.01)
    assert pressing.ask(1, Instruction.READ, bytes((70, 0, 1, 0))) == (ALERT, bytes((bits,)))
    assert pressing.gets(1, "torque_enable", "present_current") == [0, 0]
    assert pressing.write(1, 64, 1, 1) == ALERT | 1
    assert pressing.ask(2, Instruction.PING)[0] == 0
    pressing.servos[0].injected_error = 0
    pressing.motors[0].temperature_c = 30.0
    assert pressing.get(1, "hardware_error_status") == bits
    assert pressing.ask(1, Instruction.REBOOT)[0] == ALERT
    pressing.clock.sleep(0.5)
    assert pressing.ask(1, Instruction.PING)[0] == 0
    assert pressing.get(1, "hardware_error_status") == 0


@pytest.mark.parametrize(
    ("model", "voltage_v", "torque"),
    [(XM430_W350, 9.0, 1), (XM430_W350, 16.5, 1), (XL330_M288, 3.0, 0)],
)
def test_a_wrong_supply_alerts_and_ends_the_torque_of_the_330_size(model, voltage_v, torque):
    bench = ServoBench(model=model)
    bench.put(1, torque_enable=1)
    bench.motors[0].voltage_v = voltage_v
    bench.clock.sleep(0.01)
    error, data = bench.ask(1, Instruction.READ, bytes((144, 0, 2, 0)))
    assert (error, int.from_bytes(data, "little")) == (ALERT, round(10 * voltage_v))
    assert bench.get(1, "torque_enable") == torque
    assert bench.write(1, 0, 2, 0) == ALERT | ACCESS
