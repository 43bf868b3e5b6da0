"""Feedback of servos against possible motion, against the motor, and the age of its answers."""

import random
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace

import pytest

from gripper.errors import FeedbackImplausible, PositionContradicted, ServoFault
from gripper.force.ramp import ForceRamp
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics
from gripper.servos.feedback import FeedbackCheck, MotorTravel, TickClock
from gripper.settings import GripperSettings
from gripper.values.state import Cycle, GripperPhase, ServoState
from tests.values import make_servo

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)
MODEL = GripperSettings().servos[0].servo_model
PERIOD_S, UNSEEN_RAD = 0.005, 0.01
BACK_EMF_V_S = 0.9 * MODEL.back_emf_v_s
"""That of a servo with a weak magnet."""


def moving(
    speeds_rad_s: list[float],
    *,
    at_rad: float = 0.2,
    reported: float = 1.0,
    seed: int = 1,
    warm: float = 1.15,
) -> Iterator[ServoState]:
    """Give the feedback of a servo at some speeds; its position shows a share of them.

    ``warm``: resistance of its winding over that of the model.
    """
    draw, count_rad = random.Random(seed), MODEL.rad_per_pulse
    for speed_rad_s in speeds_rad_s:
        at_rad += reported * speed_rad_s * PERIOD_S
        current_a = (0.13 if speed_rad_s > 0.0 else -0.13 if speed_rad_s else -0.4) + draw.gauss(
            0.0, 0.004
        )
        voltage_v = warm * MODEL.winding_ohm * current_a + BACK_EMF_V_S * speed_rad_s
        yield replace(
            make_servo(servo_id=1, supply_v=12.0, velocity_rad_s=0.0),
            angle_rad=count_rad * round(at_rad / count_rad),
            motor_a=2.69e-3 * round(current_a / 2.69e-3),
            pwm_share=round(885 * voltage_v / 12.0) / 885,
        )


SWEEPS = [w for _ in range(4) for w in [0.15] * 60 + [-0.5] * 40 + [0.0] * 40 + [0.5] * 40]
"""Motions to and fro at two speeds, and rest on a part."""


def pushed(motor: MotorTravel, servos: Iterator[ServoState], from_s: float = 0.0) -> float:
    """Add a feedback in each period; return the largest travel that the position did not show."""
    most_rad = 0.0
    for period, servo in enumerate(servos):
        motor.push(servo, from_s + period * PERIOD_S, loaded=True)
        most_rad = max(most_rad, motor.unseen_rad)
    return most_rad


@pytest.fixture
def motor() -> MotorTravel:
    return MotorTravel(MODEL)


@pytest.mark.parametrize("seed", range(4))
def test_the_motor_agrees_with_its_position_and_has_no_more_than_its_speed(motor, seed) -> None:
    assert pushed(motor, moving(SWEEPS, seed=seed)) == 0.0
    for speed_rad_s in (-0.5, 0.0, 0.3):
        (servo,) = moving([speed_rad_s])
        least_rad_s = motor.least_rad_s(servo.supply_v * servo.pwm_share, servo.motor_a)
        assert 0.5 * abs(speed_rad_s) <= abs(least_rad_s) <= abs(speed_rad_s)
        assert least_rad_s * speed_rad_s >= 0.0


@pytest.mark.parametrize("warm", [0.9, 1.44])
def test_a_unit_with_another_winding_that_is_hot_agrees_with_its_position(motor, warm) -> None:
    assert pushed(motor, moving(SWEEPS, warm=warm)) == 0.0


def test_a_winding_that_has_become_hot_since_its_measurement_agrees_too(motor) -> None:
    pushed(motor, moving(SWEEPS, warm=1.0))
    assert pushed(motor, moving(SWEEPS, warm=1.35), 60.0) == 0.0


@pytest.mark.parametrize(
    ("speed_rad_s", "reported", "within_s"),
    [(-0.125, 0.0, 0.5), (-0.5, 0.0, 0.1), (-1.5, 0.0, 0.04), (0.5, 0.0, 0.1), (-0.5, -1.0, 0.1),
     (-0.5, 3.0, 0.15)],
)  # fmt: skip
def test_a_position_that_does_not_follow_is_found(motor, speed_rad_s, reported, within_s) -> None:
    pushed(motor, moving(SWEEPS))
    steps = moving([speed_rad_s] * round(within_s / PERIOD_S), reported=reported)
    assert pushed(motor, steps, len(SWEEPS) * PERIOD_S) > UNSEEN_RAD


def test_a_pause_between_two_readings_is_no_travel(motor) -> None:
    pushed(motor, moving([-0.5] * 40))
    assert pushed(motor, moving([0.0] * 40), 5.0) == 0.0


@pytest.mark.parametrize("loaded", [True, False])
def test_a_steady_motion_out_of_the_range_keeps_what_the_pads_hold(loaded: bool) -> None:
    check = FeedbackCheck(Mechanics(GripperSettings(), ParallelLinkage(link_m=0.06)))
    kind = PositionContradicted if loaded else FeedbackImplausible
    (still,) = moving([0.0])
    servos = [(servo, replace(still, servo_id=2)) for servo in moving([-0.05] * 800, at_rad=0.0)]
    with pytest.raises(kind, match=r"finger stands at -0\.08\d rad, it can be from -0\.080"):
        [check.check(both, n * PERIOD_S, loaded=loaded) for n, both in enumerate(servos)]
    assert bool(check.strayed) != loaded
    for n in range(30):  # where the grip is kept, it is reported once
        with nullcontext() if loaded else pytest.raises(kind):
            check.check((replace(still, angle_rad=-0.083),), 4.0 + n * PERIOD_S, loaded=loaded)


def test_a_finger_that_a_person_left_outside_may_jitter_across_the_border() -> None:
    check = FeedbackCheck(Mechanics(GripperSettings(), ParallelLinkage(link_m=0.06)))
    for n, angle_rad in enumerate([-0.095, -0.085, *[-0.0815, -0.079] * 50, -0.06]):
        (servo,) = moving([0.0], at_rad=angle_rad)
        check.check((servo,), n * PERIOD_S, loaded=True)
    assert not check.strayed


@pytest.mark.parametrize("loaded", [True, False])
@pytest.mark.parametrize(("leap_rad", "possible"), [(0.45, True), (0.55, False)])
def test_a_leap_is_what_one_and_a_half_times_the_no_load_speed_cannot_make(
    leap_rad: float, possible: bool, loaded: bool
) -> None:
    check = FeedbackCheck(Mechanics(GripperSettings(), ParallelLinkage(link_m=0.06)))
    (servo,) = moving([0.0], at_rad=0.0)
    check.check((servo,), 0.0, loaded=False)
    with nullcontext() if possible else pytest.raises(FeedbackImplausible, match="leapt"):
        check.check((replace(servo, angle_rad=leap_rad),), 0.06, loaded=loaded)


def test_a_leap_in_a_pause_is_found_before_the_next_goal(cell) -> None:
    cell.hold_part(RAMP)
    cell.gripper.keep_grip()
    cell.clock.sleep(2.0)
    goal_raw = cell.register(0, "goal_position")
    cell.servos[0].reported_offset_raw = 4096
    with pytest.raises(FeedbackImplausible, match="off by"):
        cell.gripper.release()
    assert cell.register(0, "goal_position") == goal_raw
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT


@pytest.mark.parametrize(
    ("register", "bit"),
    [("present_position", bit) for bit in (6, 11, 15)] + [("present_current", 11)],
)
def test_one_wrong_answer_changes_no_force(cell, monkeypatch, register: str, bit: int) -> None:
    cell.hold_part(RAMP)
    read, due_s, wrong = cell.bus.sync_read, cell.clock.monotonic() + 0.1, list[int]()

    def lie(ids, block) -> dict[int, dict[str, int]]:
        raws = read(ids, block)
        if not wrong and cell.clock.monotonic() >= due_s:
            raws[1][register] ^= 1 << bit
            wrong.append(raws[1][register])
        return raws

    monkeypatch.setattr(cell.bus, "sync_read", lie)
    cell.least_n = cell.peak_n = cell.force_n
    cell.gripper.hold(0.5)
    assert wrong
    assert cell.least_n == pytest.approx(cell.peak_n, abs=0.2)


def test_no_contradiction_of_a_position_ends_a_release(cell) -> None:
    cell.hold_part(RAMP)

    def drift(_cycle: Cycle) -> None:
        cell.servos[0].reported_offset_raw += 4

    cell.gripper.release(drift)
    assert cell.gripper.phase is GripperPhase.IDLE
    assert not cell.gripper._servos.feedback.check.letting_go


def test_no_finger_runs_to_its_stop_where_its_encoder_sticks_in_a_release(cell) -> None:
    cell.hold_part(RAMP)
    motor = cell.motors[0]
    motor.stuck_at_rad, held_rad = motor.angle_rad, motor.angle_rad
    with pytest.raises(PositionContradicted, match=r"servo 1.*at most 0\.3 rad"):
        cell.gripper.release()
    assert cell.force_n == 0.0
    assert abs(motor.angle_rad - held_rad) < 0.6


def test_after_a_turn_too_many_a_release_moves_nothing(cell) -> None:
    cell.hold_part(RAMP)
    cell.servos[0].reported_offset_raw = 4096
    with pytest.raises(FeedbackImplausible, match="off by"):
        cell.gripper.hold(0.1)
    cell.gripper.clear_fault()
    with pytest.raises(FeedbackImplausible, match="although its goal is the position"):
        cell.gripper.release()
    assert cell.torques == [0, 0]


def test_turns_of_a_servo_without_torque_do_not_matter(started) -> None:
    before_m = started.gripper._servos.read_patiently().aperture_m
    started.servos[0].reported_offset_raw = 2 * 4096
    assert started.gripper._servos.read_patiently().aperture_m == pytest.approx(before_m, abs=1e-4)


@pytest.mark.parametrize("offset_raw", [-4096, 800])
def test_no_goal_is_made_of_a_position_far_from_the_one_in_force(cell, offset_raw) -> None:
    cell.hold_part(RAMP)
    assert cell.register(0, "profile_acceleration") == 0, "the loop plans the motion"
    cell.gripper.close()
    cell.servos[0].reported_offset_raw = offset_raw
    goal_raw = cell.register(0, "goal_position")
    with pytest.raises(FeedbackImplausible, match=r"servo 1: .* holds the goal .* rad away"):
        cell.new_gripper().release()
    assert cell.register(0, "goal_position") == goal_raw
    assert cell.torques == [0, 0]


@pytest.mark.parametrize("servo", [0, 1])
def test_a_servo_that_has_restarted_between_two_readings_is_a_fault_at_once(cell, servo) -> None:
    """No silence tells of it, only its tick; a goal would move the other finger alone."""
    cell.hold_part(RAMP)
    cell.gripper.hold(0.5)
    core = cell.servos[servo]
    restart = cell.once(lambda: core.boot(cell.clock.monotonic(), blackout_s=0.0), in_s=0.2)
    goals_s: list[float] = []

    def observe(cycle) -> None:
        goals_s.append(cycle.t_s)
        restart(cycle)

    with pytest.raises(ServoFault, match="its torque is off although") as error:
        cell.gripper.hold(2.0, observe)
    assert (error.value.servo_id, error.value.torque_lost) == (servo + 1, True)
    assert goals_s[-1] <= cell.acted_s[0]
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.015
    assert cell.gripper.phase is GripperPhase.HELD_AFTER_FAULT
    cell.clock.sleep(1.0)
    assert cell.torques == [servo, 1 - servo]


def refused(
    rate: Callable[[float], float],
    seconds: float,
    *,
    lags: Callable[[float], bool] = lambda _now_s: False,
    pauses: bool = False,
) -> tuple[int, int, int]:
    """Return how many new answers were refused, how many old ones, and how many old ones came.

    A clock runs at a rate; where it lags each answer is the one of the period before.
    """
    generator, clock = random.Random(1), TickClock(1)
    now_s, made_s, tick_s, before_ms = 0.0, 0.0, 30.0 * generator.random(), 0
    new = old = came = 0
    while now_s < seconds:
        made_after_s = now_s + generator.uniform(0.0002, 0.0004)
        tick_s += (made_after_s - made_s) * rate(now_s)
        made_s = made_after_s
        late_s = generator.uniform(0.0, 0.01) if generator.random() < 0.01 else 0.0
        received_s = made_s + generator.uniform(0.0007, 0.002) + late_s
        tick_ms = int(1e3 * tick_s) % 32768
        if lags(now_s):
            came += 1
            old += clock.check(before_ms, now_s, received_s) is not None
        else:
            new += clock.check(tick_ms, now_s, received_s) is not None
        before_ms = tick_ms
        now_s = max(now_s + PERIOD_S, received_s)
        if pauses and generator.random() < 0.002:
            now_s += generator.uniform(0.0, 3.0)
    return new, old, came


@pytest.mark.parametrize("rate", [0.97, 0.99, 1.0, 1.01, 1.03])
@pytest.mark.parametrize("pauses", [False, True])
def test_a_clock_that_is_off_by_three_percent_is_none_that_lags(rate, pauses) -> None:
    assert refused(lambda _now_s: rate, 60.0, pauses=pauses)[0] == 0


def test_a_clock_that_slows_down_as_it_warms_up_is_none_that_lags() -> None:
    assert refused(lambda now_s: 1.0 - 1e-4 * now_s, 30.0)[0] == 0


@pytest.mark.parametrize("rate", [0.97, 1.0, 1.03])
@pytest.mark.parametrize("begins_s", [2.0, 5.1, 12.0])
def test_a_lag_of_one_period_is_refused_for_as_long_as_it_lasts(rate, begins_s) -> None:
    new, old, came = refused(lambda _now_s: rate, begins_s + 2.0, lags=lambda t_s: t_s > begins_s)
    assert new == 0
    assert old == came > 300


def test_after_a_lag_new_answers_are_taken_at_once() -> None:
    new, old, came = refused(lambda _now_s: 1.0, 20.0, lags=lambda now_s: now_s % 4.0 > 3.7)
    assert new == 0
    assert old == came > 200


def test_the_servos_own_clock_shows_old_answers_and_restarts() -> None:
    clock = TickClock(1)
    assert clock.check(32760, 0.0, 0.001) is None
    assert clock.check(2, 0.010, 0.011) is None
    assert "old answer" in str(clock.check(3, 0.040, 0.041))
    assert clock.check(33, 0.041, 0.042) is None
    assert clock.check(20000, 0.046, 0.047) is not None
    assert clock.check(20005, 0.051, 0.052) is None
    assert clock.check(1, 30.0, 30.001) is None
    assert clock.check(31000, 30.01, 30.011) is not None
    clock.forget()
    assert clock.check(7, 30.02, 30.021) is None
    assert clock.check(5007, 35.02, 35.021) is None
    assert clock.check(8007, 35.03, 35.031) is not None
