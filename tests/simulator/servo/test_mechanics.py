"""Motor and gearing: torque figures of the data sheet, loops, heat, and the friction law."""

import math

import pytest
from hypothesis import given, settings, strategies as st

from gripper.dynamixel.models import (
    MODELS,
    RH_P12_RN_A,
    XL330_M288,
    XM430_W350,
    OperatingMode as Mode,
)
from simulator.servo.gearing import Friction, data_sheet, data_sheet_drive, drawn_drive
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, RackLinkage, ServoMount
from simulator.servo.motor import (
    AMBIENT_C,
    OVERLOAD_BUDGET_S,
    DriveCommand,
    OverloadRule,
    ServoMotor,
)
from simulator.settings import SimulatedServoSettings

STEP_S = 1e-3


@pytest.fixture
def motor() -> ServoMotor:
    return ServoMotor()


def stall(motor: ServoMotor, command: DriveCommand, duration_s: float = 0.1) -> float:
    """Return the torque in N.m after the motor was held still for some time."""
    motor.drive(command)
    torque_nm = 0.0
    for _ in range(round(duration_s / STEP_S)):
        torque_nm = motor.torque_nm(STEP_S)
    return torque_nm


@pytest.mark.parametrize(("current_a", "torque_nm"), [(1.2, 1.90), (0.3, 0.309), (0.46, 0.592)])
def test_torque_with_rising_load_follows_the_fit(current_a: float, torque_nm: float):
    motor = ServoMotor(XM430_W350)
    made_nm = stall(motor, DriveCommand(Mode.CURRENT, current_a=current_a))
    assert made_nm - motor.friction_nm() == pytest.approx(torque_nm, abs=0.005)


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_full_voltage_gives_stall_current_and_no_load_speed(model):
    motor = ServoMotor(model)
    stall(motor, DriveCommand(Mode.PWM, duty=1.0))
    # The winding warms by less than 1 K in 0.1 s.
    assert motor.current_a == pytest.approx(model.stall_current_a, rel=3e-3)
    assert motor.duty == pytest.approx(1.0, abs=1e-3)
    motor.velocity_rad_s = model.no_load_rad_s
    stall(motor, DriveCommand(Mode.PWM, duty=1.0))
    friction_nm = data_sheet(model).friction_nm
    assert motor.current_a * motor.kt_nm_a == pytest.approx(friction_nm, rel=0.01)


def test_the_current_loop_settles_within_a_few_ms(motor):
    motor.drive(DriveCommand(Mode.CURRENT, current_a=1.0))
    motor.torque_nm(STEP_S)
    assert 0.2 < motor.current_a < 0.4
    for _ in range(14):
        motor.torque_nm(STEP_S)
    assert motor.current_a == pytest.approx(1.0, abs=0.02)


def test_the_velocity_loop_does_not_wind_up_beyond_the_stall_current(motor):
    stall(motor, DriveCommand(Mode.VELOCITY, velocity_rad_s=2.0), 2.0)
    # Within 2 s it warms by 9 K.
    assert motor.current_a == pytest.approx(XM430_W350.stall_current_a, rel=0.04)
    motor.velocity_rad_s = 2.5
    stall(motor, motor.command, 0.5)
    assert motor.current_a < XM430_W350.stall_current_a / 2


COUNT = XM430_W350.rad_per_pulse


@pytest.mark.parametrize(
    ("model", "mode", "gains", "speed_rad_s", "output"),
    [
        # Error of 20 counts, gains P, I, D over 128 (330 size: 256), 65536 and 16.
        (XM430_W350, Mode.POSITION, (800, 0, 0), 0.0, 125),
        (XM430_W350, Mode.CURRENT_BASED_POSITION, (800, 0, 0), 0.0, 125),
        (XL330_M288, Mode.POSITION, (400, 0, 0), 0.0, 31),
        (XL330_M288, Mode.CURRENT_BASED_POSITION, (400, 0, 0), 0.0, 31.25),
        # A speed of one count in a ms.
        (XM430_W350, Mode.POSITION, (0, 0, 800), 1e3 * COUNT, -50),
        (XM430_W350, Mode.CURRENT_BASED_POSITION, (0, 0, 800), 1e3 * COUNT, -50),
        # 100 sums.
        (XM430_W350, Mode.POSITION, (0, 6554, 0), 0.0, 200),
    ],
)
def test_the_position_loop_is_a_pid_in_counts_of_pwm_or_current(
    model, mode, gains, speed_rad_s, output
):
    motor = ServoMotor(model, angle_rad=1000 * COUNT)
    motor.velocity_rad_s = speed_rad_s
    p_gain, i_gain, d_gain = gains
    goal = 1020 * COUNT
    stall(
        motor,
        DriveCommand(
            mode, current_a=9.0, position_rad=goal, p_gain=p_gain, i_gain=i_gain, d_gain=d_gain
        ),
    )
    if mode == Mode.POSITION:
        assert motor.duty * model.whole_pwm_raw == pytest.approx(output, abs=0.01)
    else:
        assert motor.measured_a() / model.current_unit_a == pytest.approx(output, rel=1e-3)


def test_in_mode_5_goal_current_and_goal_pwm_limit_and_the_back_emf_does_not_damp(motor):
    far = DriveCommand(
        Mode.CURRENT_BASED_POSITION, current_a=0.4, position_rad=4.0, p_gain=800, duty=1.0
    )
    for speed_rad_s in (0.0, 1.0):
        motor.velocity_rad_s = speed_rad_s
        stall(motor, far)
        assert motor.current_a == pytest.approx(0.4)
    stall(motor, far._replace(duty=0.2))
    assert motor.duty == pytest.approx(0.2)
    assert motor.current_a < 0.05


@pytest.mark.parametrize("speed_rad_s", [0.0, 2.0, -2.0])
@pytest.mark.parametrize("goal_a", [0.05, -0.35])
def test_the_330_size_regulates_the_current_of_its_supply(goal_a, speed_rad_s):
    motor = ServoMotor(XL330_M288)
    motor.velocity_rad_s = speed_rad_s
    stall(motor, DriveCommand(Mode.CURRENT, current_a=goal_a))
    ohm = 5.0 / 1.47
    assert abs(motor.duty) * motor.current_a == pytest.approx(goal_a, rel=1e-3)
    assert motor.measured_a() == pytest.approx(goal_a, rel=1e-3)
    if speed_rad_s == 0.0:
        assert abs(motor.current_a) == pytest.approx(math.sqrt(5.0 * abs(goal_a) / ohm), rel=1e-3)


def test_the_pwm_slope_limits_the_change_of_the_voltage():
    motor, duties = ServoMotor(XL330_M288), []
    motor.drive(DriveCommand(Mode.PWM, duty=1.0, slope_raw=140))
    for _ in range(20):
        motor.torque_nm(STEP_S)
        duties.append(motor.duty)
    # 277 mV/ms of 5 V.
    assert duties[:2] == pytest.approx([0.0554, 0.1107], abs=2e-4)
    assert [duty < 1.0 for duty in duties[17:]] == [True, False, False]
    stall(motor, DriveCommand(), STEP_S)
    assert (motor.duty, motor.current_a) == (0.0, 0.0)


def test_a_fifth_of_the_stall_current_warms_the_winding_by_15_degrees_and_the_board_by_6(motor):
    motor.drive(DriveCommand(Mode.CURRENT, current_a=0.2 * XM430_W350.stall_current_a))
    for _ in range(40_000):
        motor.torque_nm(0.05)
    assert motor.temperature_c == pytest.approx(AMBIENT_C + 6.0, abs=0.3)
    assert motor.temperature_c + motor.winding_rise_k == pytest.approx(AMBIENT_C + 15.0, abs=0.3)
    assert motor.load_excess_s == 0.0
    warm = 1.0 + 15.0 * 0.0039
    assert motor.duty * 12.0 / motor.current_a == pytest.approx(12.0 / 2.3 * warm, rel=1e-3)


def test_the_board_follows_the_winding_late():
    # 0.8 A of the winding for 2 min: an XL330-M288 reported 11 K.
    motor = ServoMotor(XL330_M288)
    motor.drive(DriveCommand(Mode.PWM, duty=0.8 * 5.0 / 1.47 / 4.2))
    for _ in range(2400):
        motor.torque_nm(0.05)
    assert motor.current_a == pytest.approx(0.75, abs=0.02)
    rise_k = (motor.temperature_c - AMBIENT_C) * (0.8 / motor.current_a) ** 2
    assert rise_k == pytest.approx(11.0, abs=1.5)
    assert motor.winding_rise_k > 4.0 * (motor.temperature_c - AMBIENT_C)


BLOCKED = DriveCommand(Mode.CURRENT_BASED_POSITION, position_rad=9.0, p_gain=800, current_a=0.941)


@pytest.mark.parametrize(
    ("model", "rule", "command", "trips_s"),
    [
        (XM430_W350, OverloadRule.DUTY, DriveCommand(Mode.CURRENT, current_a=0.941), 5.0),
        (XM430_W350, OverloadRule.DUTY, DriveCommand(Mode.CURRENT, current_a=0.46), None),
        (XM430_W350, OverloadRule.CURRENT, DriveCommand(Mode.CURRENT, current_a=0.941), 3.5),
        (XM430_W350, OverloadRule.CURRENT, DriveCommand(Mode.CURRENT, current_a=0.5), None),
        (XL330_M288, OverloadRule.CURRENT, DriveCommand(Mode.CURRENT, current_a=0.5), 6.1),
        (XL330_M288, OverloadRule.CURRENT, DriveCommand(Mode.CURRENT, current_a=0.3), None),
        (XM430_W350, OverloadRule.FOLLOWING_ERROR, BLOCKED, 5.0),
        (XM430_W350, OverloadRule.FOLLOWING_ERROR, BLOCKED._replace(current_a=0.2), None),
        (XM430_W350, OverloadRule.FOLLOWING_ERROR, BLOCKED._replace(mode=Mode.CURRENT), None),
    ],
)
def test_each_rule_of_overload_trips_after_seconds_or_never(model, rule, command, trips_s):
    motor = ServoMotor(model)
    motor.overload_rule = rule
    motor.drive(command)
    elapsed_s = 0.0
    while motor.load_excess_s <= OVERLOAD_BUDGET_S and elapsed_s < 15.0:
        motor.torque_nm(5e-3)
        elapsed_s += 5e-3
    assert elapsed_s == pytest.approx(trips_s or 15.0, abs=0.5)
    stall(motor, DriveCommand(), 3.0)
    assert motor.load_excess_s == 0.0


@pytest.mark.parametrize("acceleration", [0.0, 5.0])
def test_the_profile_ends_on_the_goal_from_both_sides(acceleration: float):
    motor = ServoMotor(angle_rad=1.0)
    for goal_rad in (2.0, 0.5):
        motor.drive(
            DriveCommand(
                Mode.POSITION,
                position_rad=goal_rad,
                p_gain=800,
                profile_velocity_rad_s=2.0,
                profile_acceleration_rad_s2=acceleration,
            )
        )
        fastest = 0.0
        for _ in range(2000):
            motor.torque_nm(STEP_S)
            fastest = max(fastest, abs(motor.reference_velocity_rad_s))
        assert (motor.reference_rad, motor.reference_velocity_rad_s) == (goal_rad, 0.0)
        assert fastest <= 2.0


def test_a_profile_turned_round_starts_slowly_again():
    motor = ServoMotor(angle_rad=1.0)
    command = DriveCommand(
        Mode.POSITION, position_rad=2.0, profile_velocity_rad_s=2.0, profile_acceleration_rad_s2=5.0
    )
    stall(motor, command, 0.3)
    assert motor.reference_velocity_rad_s > 1.0
    stall(motor, command._replace(position_rad=0.0), STEP_S)
    assert -0.01 < motor.reference_velocity_rad_s < 0.0


def test_the_duty_is_the_voltage_of_winding_and_back_emf(motor):
    # R = 12 V / 2.3 A; k_e = (12 V - 0.2214 / 1.769 A x R) / 46 rev/min = 2.3555 V s/rad.
    motor.velocity_rad_s = 0.8
    stall(motor, DriveCommand(Mode.CURRENT, current_a=0.5))
    assert motor.duty == pytest.approx((0.5 * 5.2174 + 0.8 * 2.3555) / 12.0, rel=3e-4)
    motor.kt_factor = 1.2
    stall(motor, motor.command)
    assert motor.duty == pytest.approx((0.5 * 5.2174 + 0.8 * 1.2 * 2.3555) / 12.0, rel=3e-4)
    motor.velocity_rad_s, motor.voltage_v = 1.0, 3.0
    motor.torque_nm(STEP_S)
    assert motor.duty == 1.0


def test_factors_change_torque_and_friction(motor):
    motor.kt_factor, motor.friction_factor = 0.8, 1.5
    made_nm = stall(motor, DriveCommand(Mode.CURRENT, current_a=1.0))
    assert made_nm == pytest.approx(0.8 * 1.769, rel=1e-3)
    assert motor.friction_nm() == pytest.approx(1.5 * 0.2214)
    assert motor.viscous_nm_s == pytest.approx(1.5 * ServoMotor().viscous_nm_s)


LAW = Friction(base_nm=0.15, drive=0.3, load=0.02, load_quadratic_per_nm=0.005)


@pytest.mark.parametrize(
    ("driving_nm", "load_nm", "speed_rad_s", "friction_nm"),
    [
        (0.0, 0.0, 0.0, 0.15),
        # The square of a load that is weaker than the motor and against it; it fades with speed.
        (2.0, -1.0, 0.0, 0.15 + 0.62 + 0.005),
        (2.0, -1.0, 2.0, 0.15 + 0.62 + 0.005 * math.exp(-2.0)),
        (1.0, -2.0, 0.0, 0.15 + 0.34),
        # Both in one direction: the shares work against each other.
        (1.0, 1.0, 0.0, 0.15 + 0.28),
    ],
)
def test_the_law_is_its_formula(driving_nm, load_nm, speed_rad_s, friction_nm) -> None:
    assert LAW.torque_nm(driving_nm, load_nm, speed_rad_s) == pytest.approx(friction_nm)
    more_nm = LAW.torque_nm(driving_nm, load_nm, speed_rad_s, base_factor=3.0)
    assert more_nm - friction_nm == pytest.approx(2.0 * LAW.base_nm)


# -- Servos that are drawn at random: within the spread of real ones, the same for a seed ---------


def test_the_servos_of_a_cell_are_drawn_by_its_seed_and_their_ids():
    first, second = (SimulatedServoSettings(servo_id=n) for n in (1, 2))
    figures = [one.motor(seed).kt_nm_a for one in (first, second) for seed in (0, 1)]
    assert len(set(figures)) == 4
    assert [one.motor(seed).kt_nm_a for one in (first, second) for seed in (0, 1)] == figures
    ideal = SimulatedServoSettings(servo_id=1, gearing="ideal")
    assert ideal.motor(0).kt_nm_a == ideal.motor(1).kt_nm_a == data_sheet(XM430_W350).kt_nm_a


def test_drawn_xm430_w350_are_within_the_spread_of_real_ones():
    drives = [drawn_drive(XM430_W350, str(seed)) for seed in range(200)]
    friction_ma = [1e3 * one.friction.base_nm / one.kt_nm_a for one in drives]
    for drawn, low, high in (
        (friction_ma, 18.0, 82.0),
        ([one.kt_nm_a for one in drives], 1.65, 1.95),
        ([one.breakaway for one in drives], 1.3, 1.8),
        ([one.inertia_kg_m2 for one in drives], 0.003, 0.006),
    ):
        assert low <= min(drawn) < low + 0.2 * (high - low)
        assert high - 0.2 * (high - low) < max(drawn) <= high


@pytest.mark.parametrize("model", MODELS.values(), ids=lambda m: m.name)
def test_a_drawn_servo_is_near_its_data_sheet(model):
    typical = drawn_drive(model, None)
    volt = typical.winding_ohm * model.stall_current_a
    assert volt == pytest.approx(model.nominal_voltage_v, rel=0.01)
    law, driving_nm = typical.friction, typical.kt_nm_a * model.stall_current_a
    volt_per_nm = typical.winding_ohm / (typical.kt_nm_a * (1.0 - law.drive))
    turning_v_s = typical.back_emf_v_s + volt_per_nm * law.viscous_nm_s
    no_load_rad_s = (volt - volt_per_nm * law.base_nm) / turning_v_s
    assert no_load_rad_s == pytest.approx(model.no_load_rad_s, rel=0.05)
    left_nm, load = driving_nm * (1.0 - law.drive) - law.base_nm, 1.0 + law.load
    # Load and its square are what is left: load x + quadratic x² = left.
    root = math.sqrt(load * load + 4.0 * law.load_quadratic_per_nm * left_nm)
    # The vendor's stall torque of an XL330 is 1.4 to 1.8 times that of its logs.
    assert 0.5 < 2.0 * left_nm / (load + root) / model.stall_torque_nm < 1.05


# -- Fingers ---------------------------------------------------------------------------------------


MOUNTS = (ServoMount(direction=1), ServoMount(direction=-1))


def fingers(count=2, *, model=XM430_W350, linkage=None, aperture_m=0.04, figures=None, **options):
    return FingerMechanics(
        [ServoMotor(model, figures=figures) for _ in range(count)],
        MOUNTS[:count],
        linkage or ParallelogramLinkage(link_m=0.06),
        aperture_m=aperture_m,
        **options,
    )


def push(mechanics: FingerMechanics, closing_a: float) -> None:
    """Let every motor close with a current in A."""
    for motor, mount in zip(mechanics.motors, MOUNTS, strict=False):
        motor.drive(DriveCommand(Mode.CURRENT, current_a=-mount.direction * closing_a))


def press(mechanics, wall_m, stiffness_n_m, duration_s, dt_s=STEP_S, *, implicit=True):
    """Press both fingers on springs that begin at a half opening; return the last forces in N."""
    force = (0.0, 0.0)
    for _ in range(round(duration_s / dt_s)):
        depths = [max(0.0, wall_m - x) for x in mechanics.finger_position_m]
        force = (stiffness_n_m * depths[0], stiffness_n_m * depths[1])
        stiffnesses = tuple(stiffness_n_m if d > 0.0 else 0.0 for d in depths)
        mechanics.step(dt_s, force, stiffnesses if implicit else (0.0, 0.0))
    return force


@pytest.mark.parametrize("linkage", [ParallelogramLinkage(offset_m=0.005), RackLinkage()])
@given(half_m=st.floats(0.0, 0.045))
@settings(max_examples=40)
def test_linkages_invert_and_differentiate(linkage, half_m: float):
    angle = linkage.angle_rad(half_m)
    assert linkage.half_opening_m(angle) == pytest.approx(half_m, abs=1e-12)
    slope = (linkage.half_opening_m(angle + 1e-6) - linkage.half_opening_m(angle - 1e-6)) / 2e-6
    assert linkage.slope_m_rad(angle) == pytest.approx(slope, rel=1e-5)
    assert linkage.half_opening_m(angle) < linkage.half_opening_max_m


@pytest.mark.parametrize("count", [1, 2])
def test_closing_current_gives_the_force_of_the_torque_fit(count: int):
    mechanics = fingers(count)
    push(mechanics, 0.6)
    force = press(mechanics, 0.015, 20_000.0, 2.0)
    slope = 0.06 * math.cos(math.asin(0.0148 / 0.06))
    expected_n = (1.769 * 0.6 - 0.2214) / slope * (0.5 if count == 1 else 1.0)
    # Inertia presses a little deeper before the friction locks, in the band of twice the friction.
    assert expected_n - 0.2 <= force[0] <= expected_n + 2.1 * 0.2214 / slope
    assert force[0] == pytest.approx(force[1], rel=0.02)


def held_n(mechanics, current_a: float, before_a: float) -> float:
    """Return the force on a soft spring after the current went slowly from another one."""
    for i in range(1, 2001):
        push(mechanics, before_a + (current_a - before_a) * i / 2000)
        force = press(mechanics, 0.0195, 3_000.0, STEP_S)
    return force[0]


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_unloading_holds_more_by_twice_the_friction_and_that_of_the_load(share: float):
    mechanics = fingers(figures=data_sheet_drive(XM430_W350, share))

    loading_n = held_n(mechanics, 0.5, 0.0)
    held_n(mechanics, 1.0, 0.5)
    unloading_n = held_n(mechanics, 0.5, 1.0)
    slope = 0.06 * math.cos(math.asin(0.0165 / 0.06))
    assert loading_n == pytest.approx((1.769 * 0.5 - 0.2214) / slope, rel=0.06)
    most_n = (1.0 + share) / (1.0 - share) * (1.769 * 0.5 + 0.2214) / slope
    assert unloading_n - loading_n == pytest.approx(most_n - loading_n, rel=0.12)


@pytest.mark.parametrize(
    ("hand", "stiffness_n_m", "implicit"),
    [
        ({}, 500.0, True),
        ({}, 50_000.0, False),
        ({"linkage": RackLinkage()}, 5_000.0, False),
        ({"model": XL330_M288}, 5_000.0, True),
        ({"model": XL330_M288, "linkage": RackLinkage()}, 500.0, False),
        ({"model": XL330_M288, "linkage": RackLinkage()}, 50_000.0, True),
        *(({"model": RH_P12_RN_A}, stiffness, True) for stiffness in (500.0, 5e3, 5e4)),
    ],
)
def test_contact_comes_to_rest_at_any_stiffness_and_stays(hand, stiffness_n_m, implicit):
    mechanics = fingers(**hand)
    push(mechanics, 0.5)
    press(mechanics, 0.018, stiffness_n_m, 3.0, implicit=implicit)
    assert [motor.velocity_rad_s for motor in mechanics.motors] == [0.0, 0.0]
    held = mechanics.finger_position_m
    press(mechanics, 0.018, stiffness_n_m, 1.0, implicit=implicit)
    assert mechanics.finger_position_m == held
    assert max(held) < 0.018


def test_end_stops_hold_the_fingers():
    mechanics = fingers(half_opening_min_m=0.002)
    push(mechanics, 0.5)
    press(mechanics, 0.0, 0.0, 1.0)
    assert mechanics.finger_position_m == pytest.approx((0.002, 0.002), abs=1e-9)
    push(mechanics, -0.5)
    press(mechanics, 0.0, 0.0, 1.0)
    widest_m = ParallelogramLinkage(link_m=0.06).half_opening_max_m
    assert mechanics.finger_position_m == pytest.approx((widest_m, widest_m), abs=1e-9)
