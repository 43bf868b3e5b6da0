"""Modes, watchdog and protections: what the servo does to its motor."""

from collections.abc import Callable

import pytest

from gripper.dynamixel.models import XC330_M288, XL330_M288, XM430_W350
from simulator.servo.firmware import WatchdogStop
from simulator.servo.motor import DriveMode
from simulator.servo.protocol2 import Instruction, encode_instruction

ALERT = 0x80


@pytest.fixture
def closing(servo_bench: Callable):
    """Return a bench in mode 5 that presses both fingers on a wall with 100 counts of current."""

    def make(watchdog_stop: WatchdogStop = WatchdogStop.HOLD):
        bench = servo_bench(settings={"operating_mode": 5})
        for servo in bench.servos:
            servo.core.watchdog_stop = watchdog_stop
        bench.clock.sleep(0.01)
        for servo_id in (1, 2):
            present = bench.read(servo_id, 132, 4)
            assert bench.write(servo_id, 116, 4, present) == 0
            assert bench.write(servo_id, 102, 2, 100) == 0
            assert bench.write(servo_id, 64, 1, 1) == 0
            assert bench.write(servo_id, 116, 4, 2048) == 0
        bench.force_n = (9.0, 9.0)
        return bench

    return make


@pytest.fixture
def bench(closing):
    return closing()


def test_position_mode_reaches_its_goal_and_says_so(servo_bench):
    bench = servo_bench()
    goal = bench.read(1, 132, 4) - 300
    bench.write(1, 112, 4, 100)
    bench.write(1, 64, 1, 1)
    assert bench.write(1, 116, 4, goal) == 0
    bench.clock.sleep(0.05)
    assert bench.read(1, 122, 1) == 1
    assert bench.read(1, 123, 1) == 0x32
    assert bench.read(1, 128, 4, signed=True) < -50
    bench.clock.sleep(1.5)
    assert bench.read(1, 132, 4) == pytest.approx(goal, abs=12)
    assert bench.read(1, 122, 1) == 0
    assert bench.read(1, 123, 1) == 0x31
    assert bench.read(1, 140, 4) == goal


@pytest.mark.parametrize(
    ("mode", "goal_item", "goal", "shown_item"),
    [(0, (102, 2), -80, (126, 2)), (1, (104, 4), -40, (128, 4)), (16, (100, 2), -200, (124, 2))],
    ids=["current", "velocity", "pwm"],
)
def test_current_velocity_and_pwm_modes(servo_bench, mode, goal_item, goal, shown_item):
    bench = servo_bench(settings={"operating_mode": mode})
    assert bench.write(1, *goal_item, 0) == 0
    bench.write(1, 64, 1, 1)
    assert bench.write(1, *goal_item, goal) == 0
    bench.clock.sleep(0.2)
    assert bench.read(1, *shown_item, signed=True) == pytest.approx(goal, abs=3)
    assert bench.motors[0].velocity_rad_s < 0.0


@pytest.mark.parametrize(
    ("mode", "goal_address", "limit", "shown_address"),
    [(0, 102, (38, 2, 90), 126), (16, 100, (36, 2, 300), 124)],
    ids=["current", "pwm"],
)
def test_a_limit_lowered_afterwards_bounds_the_goal(
    servo_bench, mode, goal_address, limit, shown_address
):
    bench = servo_bench(settings={"operating_mode": mode})
    bench.write(1, goal_address, 2, -700)
    bench.write(1, *limit)
    bench.write(1, 64, 1, 1)
    bench.clock.sleep(0.05)
    assert bench.read(1, shown_address, 2, signed=True) == pytest.approx(-limit[-1], abs=2)


def test_the_gains_reach_the_motor(servo_bench):
    bench = servo_bench(model=XC330_M288, settings={"operating_mode": 5})
    bench.write(1, 64, 1, 1)
    assert (bench.motors[0].command.p_gain, bench.motors[0].command.d_gain) == (1100, 500)
    bench.write(1, 80, 2, 700)
    bench.write(1, 84, 2, 900)
    assert (bench.motors[0].command.p_gain, bench.motors[0].command.d_gain) == (900, 700)
    bench.write(1, 98, 1, 1)
    bench.clock.sleep(0.05)
    assert (bench.motors[0].command.p_gain, bench.motors[0].command.d_gain) == (900, 700)


@pytest.mark.parametrize(("model", "obeyed"), [(XM430_W350, 1), (XL330_M288, 0)])
def test_the_profile_reaches_the_motor_but_not_in_mode_5_of_the_330_size(
    servo_bench, model, obeyed: int
):
    bench = servo_bench(model=model, settings={"operating_mode": 5})
    bench.write(1, 112, 4, 40)
    bench.write(1, 108, 4, 20)
    bench.write(1, 64, 1, 1)
    bench.write(1, 116, 4, 2048)
    command = bench.motors[0].command
    assert command.profile_velocity_rad_s == obeyed * 40 * XM430_W350.velocity_unit_rad_s
    assert command.profile_acceleration_rad_s2 == obeyed * 20 * XM430_W350.acceleration_unit_rad_s2


def test_reverse_mode_turns_the_motor_the_other_way(servo_bench):
    bench = servo_bench(settings={"operating_mode": 1, "drive_mode": 1})
    bench.write(1, 64, 1, 1)
    bench.write(1, 104, 4, 40)
    bench.clock.sleep(0.1)
    assert bench.motors[0].velocity_rad_s < 0.0
    assert bench.read(1, 128, 4, signed=True) == pytest.approx(40, abs=4)


# Bus watchdog


def test_any_packet_feeds_the_watchdog(bench):
    bench.write(1, 98, 1, 5)
    for _ in range(10):
        bench.clock.sleep(0.07)
        bench.stream.write(encode_instruction(200, Instruction.PING))
    assert bench.read(1, 98, 1) == 5


def test_a_damaged_packet_does_not_feed_the_watchdog(bench):
    bench.write(1, 98, 1, 2)
    bad = bytearray(encode_instruction(200, Instruction.PING))
    bad[-1] ^= 1
    bench.clock.sleep(0.03)
    bench.stream.write(bytes(bad))
    bench.clock.sleep(0.03)
    assert bench.read(1, 98, 1, signed=True) == -1


def trip(bench):
    bench.clock.sleep(0.3)
    bench.write(1, 98, 1, 5)
    bench.clock.sleep(0.11)
    assert bench.servos[0].core.watchdog_tripped


def test_a_trip_holds_the_present_position(bench):
    trip(bench)
    command = bench.motors[0].command
    assert command.mode is DriveMode.CURRENT_POSITION
    assert command.current_a == pytest.approx(0.269)
    held = bench.motors[0].angle_rad
    bench.force_n = (0.0, 0.0)
    bench.clock.sleep(0.5)
    assert bench.motors[0].angle_rad == pytest.approx(held, abs=0.03)


def test_a_trip_can_leave_the_motor_without_current(closing):
    bench = closing(WatchdogStop.ZERO_CURRENT)
    trip(bench)
    bench.clock.sleep(0.05)
    assert bench.read(1, 126, 2, signed=True) == 0
    assert bench.read(1, 64, 1) == 1


def test_the_330_fault_keeps_turning(closing):
    bench = closing(WatchdogStop.KEEPS_TURNING)
    trip(bench)
    bench.clock.sleep(0.05)
    assert bench.read(1, 126, 2, signed=True) == -100
    assert bench.write(1, 102, 2, 0) == 4


def test_a_cleared_motor_waits_for_a_goal(bench):
    trip(bench)
    stopped = bench.motors[0].command
    assert bench.write(1, 98, 1, 0) == 0
    assert bench.write(1, 112, 4, 10) == 0
    assert bench.motors[0].command == stopped
    assert bench.write(1, 116, 4, 2048) == 0
    assert bench.motors[0].command != stopped


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
def test_a_latched_error_drops_the_torque_until_a_reboot(bench, provoke, bits: int):
    bench.clock.sleep(0.1)
    provoke(bench.servos[0].core)
    bench.clock.sleep(0.01)
    assert bench.ask(1, Instruction.READ, bytes((70, 0, 1, 0))) == (ALERT, bytes((bits,)))
    assert bench.read(1, 64, 1) == 0
    assert bench.read(1, 126, 2) == 0
    assert bench.write(1, 64, 1, 1) == ALERT | 1
    assert bench.ask(2, Instruction.PING)[0] == 0
    bench.servos[0].core.injected_error = 0
    bench.motors[0].temperature_c = 30.0
    assert bench.read(1, 70, 1) == bits
    assert bench.ask(1, Instruction.REBOOT)[0] == ALERT
    bench.clock.sleep(0.5)
    assert bench.ask(1, Instruction.PING)[0] == 0
    assert bench.read(1, 70, 1) == 0


@pytest.mark.parametrize("voltage_v", [9.0, 16.5])
def test_a_wrong_supply_alerts_but_keeps_the_torque_by_default(bench, voltage_v: float):
    bench.motors[0].voltage_v = voltage_v
    bench.clock.sleep(0.01)
    error, data = bench.ask(1, Instruction.READ, bytes((144, 0, 2, 0)))
    assert (error, int.from_bytes(data, "little")) == (ALERT, round(10 * voltage_v))
    assert bench.read(1, 64, 1) == 1
    assert bench.write(1, 0, 2, 0) == ALERT | 7


def test_the_xl330_shuts_down_on_a_wrong_supply(servo_bench):
    bench = servo_bench(model=XL330_M288)
    bench.write(1, 64, 1, 1)
    bench.motors[0].voltage_v = 3.0
    bench.clock.sleep(0.01)
    assert bench.read(1, 64, 1) == 0


def test_an_error_that_lasts_comes_back_after_the_reboot(bench):
    bench.motors[0].temperature_c = 95.0
    bench.clock.sleep(0.01)
    bench.ask(1, Instruction.REBOOT)
    bench.clock.sleep(0.5)
    assert bench.read(1, 70, 1) == 0x04
