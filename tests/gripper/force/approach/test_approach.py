import random
from dataclasses import replace

import pytest

from gripper.force.approach.approach import Approach, ApproachEvent, ContactDetector, ContactRest
from gripper.force.loop import Moment
from gripper.force.ramp import ForceRamp
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.state import Cycle, GripperPhase, ServoFeedback
from tests.values import make_servo, make_state, measured_drives

LINKAGE = ParallelLinkage(link_m=0.06)
SETTINGS = GripperSettings(
    servos=(ServoSettings(servo_id=1), ServoSettings(servo_id=2)), contact_timeout_s=3.0
)
DT_S = 0.005
MECHANICS = Mechanics(SETTINGS, LINKAGE, measured_drives(SETTINGS))


def sample(t_s: float, first_n: float, second_n: float, valid: bool = True) -> ForceSample:
    return ForceSample(t_s=t_s, force_n=(first_n, second_n), valid=valid)


def state(t_s: float, aperture_m: float, speed_m_s: float, current_a: float = 0.1) -> ServoFeedback:
    angle_rad = LINKAGE.angles_rad(aperture_m)[0]
    servo = make_servo(
        angle_rad=angle_rad, velocity_rad_s=0.5 * speed_m_s / 0.06, current_a=-current_a
    )
    return make_state(
        t_s,
        aperture_m=aperture_m,
        aperture_velocity_m_s=speed_m_s,
        current_a=current_a,
        servos=(servo, replace(servo, servo_id=2)),
    )


def new_approach(aperture_m: float = 0.02) -> Approach:
    return Approach(MECHANICS, state(0.0, aperture_m, 0.0))


@pytest.fixture
def approach() -> Approach:
    return new_approach()


def step(
    approach: Approach, t_s: float, dt_s: float, at: ServoFeedback, seen: ForceSample | None
) -> tuple[ApproachEvent, tuple[float, ...]]:
    action = approach.step(Moment(now_s=t_s, dt_s=dt_s, state=at, sample=seen))
    assert action.done == (approach.event is not ApproachEvent.CLOSING)
    return approach.event, tuple(goal.angle_rad for goal in action.goals)


def test_contact_takes_several_new_samples_on_each_pad() -> None:
    detector = ContactDetector(0.5, 3)
    for _ in range(5):
        detector.push(sample(0.0, 1.0, 1.0))
    assert detector.touched == (False, False)
    detector.push(sample(0.02, 1.0, 0.4))
    detector.push(sample(0.04, 1.0, 1.0))
    assert detector.touched == (True, False)
    detector.push(sample(0.06, 0.1, 1.0))
    assert detector.touched == (False, False)


def test_a_finger_that_touches_waits_while_the_other_closes_on(approach) -> None:
    goals = [LINKAGE.angles_rad(0.02)]
    for i in range(40):
        t_s = 0.02 * i
        at = state(t_s, 0.02 - 0.0004 * i, -0.02)
        event, angles = step(approach, t_s, 0.01, at, sample(t_s, 1.0, 0.0))
        assert event is ApproachEvent.CLOSING
        goals.append(tuple(angles))
    assert goals[-1][0] == goals[10][0]
    assert goals[-1][1] < goals[10][1]
    _, angles = step(approach, 1.0, 0.01, state(1.0, 0.004, -0.02), sample(1.0, 0.0, 0.0))
    assert angles[0] == angles[1]


def test_the_goal_runs_ahead_by_a_little_and_of_fingers_that_break_loose_by_less(approach) -> None:
    for i in range(200):
        _, stuck = step(approach, 0.005 * i, DT_S, state(0.005 * i, 0.02, 0.0), None)
    _, loose = step(approach, 1.0, DT_S, state(1.0, 0.0199, -0.06), None)
    assert 0.02 - 0.0061 <= LINKAGE.aperture_m(stuck) < 0.02 - 0.005
    assert LINKAGE.aperture_m(loose) > 0.0199 - 0.0025


@pytest.mark.parametrize(("t_s", "aperture_m"), [(0.0, 0.0004), (3.0, 0.02)])
def test_closed_or_out_of_time_is_the_limit_even_when_the_pads_touch_each_other(
    t_s, aperture_m
) -> None:
    at = state(t_s, aperture_m, -0.02)
    seen = sample(t_s, 5.0, 5.0) if t_s == 0.0 else None
    assert step(new_approach(aperture_m), t_s, DT_S, at, seen)[0] is ApproachEvent.LIMIT


@pytest.mark.parametrize(
    ("one_pad_n", "ends"), [(0.0, ApproachEvent.OBSTRUCTED), (1.0, ApproachEvent.CONTACT)]
)
def test_a_standstill_at_the_current_limit_is_a_contact_with_one_pad_alone(one_pad_n, ends) -> None:
    approach = new_approach(0.01)
    closing_a = approach.currents_a[0]
    event, i = ApproachEvent.CLOSING, 0
    while event is ApproachEvent.CLOSING:
        t_s = DT_S * i
        at = state(t_s, 0.01, 0.0, approach.currents_a[0])
        event, _ = step(approach, t_s, DT_S, at, sample(t_s, 0.0, one_pad_n))
        i += 1
    assert event is ends
    assert 0.4 < DT_S * i < 0.7
    assert (approach.currents_a[0] > closing_a) is (one_pad_n == 0.0)
    assert approach.currents_a[0] <= closing_a * 1.6 + 1e-9


def test_the_cap_is_named_where_it_limits_the_current_of_fingers_that_stand() -> None:
    advices = []
    for cap_n in (SETTINGS.force_max_n, 1.5):
        mechanics = MECHANICS.with_settings(replace(SETTINGS, force_max_n=cap_n))
        approach = Approach(mechanics, state(0.0, 0.01, 0.0))
        for i in range(40):
            step(approach, DT_S * i, DT_S, state(DT_S * i, 0.01, 0.0), None)
        advices.append(approach.friction_advice)
    assert not advices[0]
    assert "servo 1 does not overcome its friction" in advices[1]
    assert "gripper.force_max_n = 1.5 N" in advices[1]


@pytest.mark.parametrize("forces_n", [(0.25, 0.0), (0.0, 0.25)])
def test_a_touch_of_either_pad_brakes_a_servo_that_drives_both_while_it_lasts(forces_n) -> None:
    settings = replace(SETTINGS, servos=SETTINGS.servos[:1])
    mechanics = Mechanics(settings, replace(LINKAGE, n_servos=1), measured_drives(settings))
    begin = state(0.0, 0.02, 0.0)
    approach = Approach(mechanics, replace(begin, servos=begin.servos[:1]))
    for i in range(60):
        at = state(DT_S * i, 0.02, -0.012)
        at = replace(at, servos=at.servos[:1])
        touches = i >= 40
        young = replace(scan(DT_S * i, 0.0), force_n=forces_n if touches else (0.0, 0.0))
        _, (goal_rad,) = step(approach, DT_S * i, DT_S, at, young)
        assert (goal_rad == at.servos[0].angle_rad) is touches


def test_an_invalid_sample_shows_no_contact(approach) -> None:
    for i in range(5):
        at = state(0.02 * i, 0.02, -0.02)
        event, _ = step(approach, 0.02 * i, DT_S, at, sample(0.02 * i, 9.0, 9.0, valid=False))
    assert event is ApproachEvent.CLOSING


def scan(t_s: float, force_n: float, noise_n: float = 0.1) -> ForceSample:
    return ForceSample(t_s=t_s, force_n=(force_n, force_n), lag_s=0.0015, noise_n=noise_n)


def test_pads_that_are_noisy_while_empty_brake_by_what_stands_out() -> None:
    draw, approach = random.Random(3), new_approach()
    forces_n = [draw.gauss(0.0, 0.3) for _ in range(200)] + [0.9] * 4
    ahead_rad = []
    for i, force_n in enumerate(forces_n):
        at = state(DT_S * i, 0.02, -0.012)
        _, angles = step(approach, DT_S * i, DT_S, at, scan(DT_S * i, force_n))
        ahead_rad.append(tuple(a - b for a, b in zip(at.angles_rad, angles, strict=True)))
    assert sum(max(ahead) == 0.0 for ahead in ahead_rad[:200]) <= 25
    assert (0.0, 0.0) in ahead_rad[200:]


@pytest.mark.parametrize("rate_hz", [None, 333.0])
def test_fast_force_meets_a_part_more_gently(make_started, rate_hz) -> None:
    cell = make_started(rate_hz=rate_hz, noise_n=0.1, friction_error=-0.15)
    cell.part.stiffness_n_m = 6000.0
    peaks_n: list[float] = []

    def watch(cycle: Cycle) -> None:
        if cycle.setpoint_n == 0.0:
            peaks_n.append(cell.peak_n)

    assert cell.gripper.grasp(ForceRamp.linear(2.0, rate_n_s=3.0), watch).contact_t_s is not None
    assert (peaks_n[-1] < 1.0) is (rate_hz is not None)


@pytest.mark.parametrize(
    ("period_s", "noise_n", "hard_n", "lasts_s"),
    [
        (0.02, 0.3, 1.0, 0.08),
        (0.005, 0.15, 1.0, 0.03),
        (0.001, 0.01, 1.0, 0.01),
        (0.001, 0.01, 0.6, 0.065),
    ],
)
def test_the_rest_ends_where_the_force_of_a_light_touch_is_known(
    period_s, noise_n, hard_n, lasts_s
) -> None:
    rest, t_s, goes_on = ContactRest(0.0, hard_n=hard_n), -DT_S, True
    while goes_on:
        t_s += DT_S
        new = scan(period_s * int(t_s / period_s + 1e-9), 0.7, noise_n)
        moment = Moment(now_s=t_s, dt_s=DT_S, state=state(t_s, 0.01, 0.0), sample=new)
        goes_on = rest.goes_on(moment)
    assert t_s == pytest.approx(lasts_s, abs=0.009)
    assert rest.force_n == pytest.approx(0.7)


@pytest.mark.parametrize("near_m_s", [0.012, 0.015])
def test_fingers_that_travel_start_hard_and_slow_to_their_speed(make_started, near_m_s) -> None:
    cell = make_started(rate_hz=200.0, noise_n=0.01, approach_speed_m_s=near_m_s, force_max_n=15.0)
    cell.gripper.grasp(ForceRamp.linear(2.0, rate_n_s=20.0))
    cell.gripper.release()
    seen: list[tuple[float, float]] = []

    def watch(cycle: Cycle) -> None:
        if cycle.phase is GripperPhase.APPROACHING and not cell.force_n:
            seen.append((cycle.t_s, -cycle.state.aperture_velocity_m_s))

    cell.gripper.grasp(ForceRamp.linear(2.0, rate_n_s=20.0), watch)
    fast_s = next(t_s for t_s, speed in seen if speed > 0.04)
    assert fast_s - seen[0][0] < 0.035
    assert seen[-1][1] == pytest.approx(near_m_s, rel=0.25)
    assert min(speed for t_s, speed in seen if t_s > fast_s) > 0.6 * near_m_s
