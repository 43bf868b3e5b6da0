"""What a simulated servo measures: the velocity by its encoder, and noise."""

import math
from itertools import pairwise
from statistics import mean, pstdev

import pytest

from gripper.dynamixel.models import XC330_M288, XL330_M288, XM430_W210, XM430_W350, OperatingMode
from simulator.servo.motor import DriveCommand, ServoMotor, ServoNoise, VelocityRegister

STEP_S = 1e-3


@pytest.mark.parametrize(
    ("model", "window_s", "low_pass_s"),
    [(XM430_W350, 0.064, 0.016), (XM430_W210, 0.064, 0.016)]
    + [(model, 0.032, 0.004) for model in (XL330_M288, XC330_M288)],
)
@pytest.mark.parametrize("step_s", [1e-3, 5e-4])
def test_the_register_is_the_mean_of_a_window_after_a_low_pass(model, window_s, low_pass_s, step_s):
    register, raws, counts_s = VelocityRegister(model, 100), [], 1600.0
    for i in range(1, round(0.3 / step_s) + 1):
        register.step(100 + math.floor(counts_s * i * step_s), step_s)
        raws.append(register.raw)
    speed = counts_s * model.rad_per_pulse / model.velocity_unit_rad_s
    assert raws[-1] == pytest.approx(speed, abs=2.0)
    # The delay of a register behind a start of constant speed is the area that it lacks.
    late_s = sum(1.0 - raw / speed for raw in raws) * step_s
    assert late_s == pytest.approx(0.5 * window_s + low_pass_s, abs=0.004)


@pytest.mark.parametrize(("model", "raw"), [(XM430_W350, 1), (XL330_M288, 2)])
def test_the_x430_drops_the_fraction_and_the_x330_rounds(model, raw):
    for sign in (1, -1):
        register = VelocityRegister(model, 0)
        # A count in 64 ms is one unit of the register: 1.8 units here.
        for i in range(1, 2001):
            register.step(sign * math.floor(i * 1.8 / 64.0), STEP_S)
        assert register.raw == sign * raw


def test_a_stuck_encoder_reads_no_velocity_after_its_window():
    motor = ServoMotor()
    motor.drive(DriveCommand(OperatingMode.CURRENT))
    motor.velocity_rad_s = 1.0
    for _ in range(300):
        motor.angle_rad += STEP_S
        motor.torque_nm(STEP_S)
    assert motor.velocity_register.raw == pytest.approx(41, abs=1)
    motor.stuck_at_rad = motor.angle_rad
    for after_s, raw in ((0.032, 25), (0.12, 0)):
        for _ in range(round(after_s / STEP_S)):
            motor.torque_nm(STEP_S)
        assert abs(motor.velocity_register.raw - raw) <= 4 * (raw > 0)


def test_at_rest_a_count_changes_in_a_quarter_of_the_samples_and_the_velocity_is_0():
    changes = []
    for phase in range(10):
        motor = ServoMotor(
            angle_rad=(100.0 + 0.1 * phase) * XM430_W350.rad_per_pulse, noise=ServoNoise("1")
        )
        counts, raws = [], set()
        for _ in range(300):
            for _ in range(10):
                motor.torque_nm(STEP_S)
            counts.append(motor.sensed_count)
            raws.add(motor.velocity_register.raw)
        changes.append(sum(a != b for a, b in pairwise(counts)) / 299)
        assert raws <= {-1, 0, 1}
        assert max(counts) - min(counts) <= 2
    assert 0.05 < min(changes) < 0.16
    assert sum(changes) / 10 == pytest.approx(0.28, abs=0.06)
    motor.stuck_at_rad = motor.angle_rad
    stuck = motor.sensed_count
    assert {motor.torque_nm(STEP_S) or motor.sensed_count for _ in range(50)} == {stuck}


@pytest.mark.parametrize(
    ("model", "speed_rad_s", "sd_a"),
    [
        (XM430_W350, 0.0, 3.4e-3),
        (XM430_W350, -0.3, 7.2e-3),
        (XM430_W350, 2.0, 13e-3),
        (XL330_M288, 0.0, 0.0),
    ],
)
def test_the_measured_current_has_the_noise_of_the_logs(model, speed_rad_s, sd_a):
    motor = ServoMotor(model, noise=ServoNoise("2"))
    motor.velocity_rad_s = speed_rad_s
    motor.drive(DriveCommand(OperatingMode.CURRENT, current_a=0.2))
    for _ in range(100):
        motor.torque_nm(STEP_S)
    measured = [motor.measured_a() for _ in range(1000)]
    assert mean(measured) == pytest.approx(0.2, abs=2e-3)
    assert pstdev(measured) == pytest.approx(sd_a, rel=0.1)
    motor.drive(DriveCommand())
    motor.torque_nm(STEP_S)
    assert motor.measured_a() == 0.0


@pytest.mark.parametrize(
    ("duty", "sd_v"), [(0.0, 0.0), (0.35, 0.46), (0.65, 0.86), (0.95, 0.26), (1.0, 0.0)]
)
def test_the_supply_of_a_330_size_that_holds_has_the_noise_of_the_logs(duty, sd_v):
    motor = ServoMotor(XL330_M288, noise=ServoNoise("3"))
    motor.voltage_v = 7.3
    motor.drive(DriveCommand(OperatingMode.PWM, duty=duty))
    motor.torque_nm(STEP_S)
    measured = [motor.measured_v() for _ in range(1000)]
    assert mean(measured) == pytest.approx(7.3, abs=0.1)
    assert pstdev(measured) == pytest.approx(sd_v, rel=0.1)


def test_noise_is_that_of_its_seed_and_a_servo_without_it_measures_exactly():
    one, same, other = (ServoNoise(seed) for seed in ("4", "4", "5"))
    drawn = [[noise.dither(), noise.current_a(0.0)] for noise in (one, same, other)]
    assert drawn[0] == drawn[1] != drawn[2]
    motor = ServoMotor(XL330_M288)
    motor.drive(DriveCommand(OperatingMode.PWM, duty=0.5))
    motor.torque_nm(STEP_S)
    assert motor.measured_v() == motor.voltage_v
