"""Limits of the goals: force, current, age of the feedback."""

import random
from dataclasses import replace
from unittest.mock import Mock

import pytest

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import BusUnreliable, ForceAboveCap, ForceSensorStale, LimitExceeded
from gripper.force.ramp import ForceRamp
from gripper.mechanics.impact import SLOWEST_M_S, impact_limit
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Drives, Mechanics
from gripper.servos.goal_limits import GoalWriter, ServoGoal
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.state import ServoFeedback
from simulator.clock import VirtualClock
from tests.values import make_servo, make_state, measured_drives

LINKAGE = ParallelLinkage(link_m=0.06)

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)


SETTINGS = GripperSettings(servos=(ServoSettings(servo_id=1),))
PAIR = GripperSettings()


def make_writer(settings: GripperSettings = PAIR, drives: Drives | None = None) -> GoalWriter:
    clock = VirtualClock()
    clock.sleep(1.0)  # the time of `make_state`
    linkage = replace(LINKAGE, n_servos=len(settings.servos))
    mechanics = Mechanics(settings, linkage, drives or measured_drives(PAIR))
    return GoalWriter(Mock(), mechanics, clock)


@pytest.mark.parametrize(("over_n", "at_most_s"), [(0.8, 0.03), (3.0, 0.006)])
def test_the_cap_is_noticed_the_sooner_the_more_it_is_passed(over_n, at_most_s) -> None:
    draw, writer, reported_s = random.Random(4), make_writer(SETTINGS), None
    for i in range(2200):
        t_s = 0.005 * i
        force_n = SETTINGS.force_max_n + (over_n if t_s > 10.0 else -0.5) + draw.gauss(0.0, 0.3)
        sample = ForceSample(t_s=t_s, force_n=(force_n, force_n), lag_s=0.0015, noise_n=0.21)
        writer.note_force(sample)
        if reported_s is None and writer.force_is_too_high():
            reported_s = t_s
    assert 10.0 < reported_s <= 10.0 + at_most_s


@pytest.mark.parametrize(("measured_n", "at_least"), [(5.0, True), (8.5, False)])
def test_no_force_of_taxels_at_full_scale_is_used_for_control(
    make_cell, measured_n, at_least
) -> None:
    cell = make_cell(force_max_n=6.0, rate_hz=200.0, noise_n=0.1)
    cell.hold_part(RAMP)

    def fill() -> None:
        cell.sensor.valid, cell.sensor.at_least = False, at_least
        cell.sensor.gain, cell.sensor.offset_n = 0.0, measured_n

    with pytest.raises(ForceSensorStale):
        cell.gripper.hold(1.0, cell.once(fill))
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.15
    assert cell.force_n > 1.0


FRICTION_N, ONE_N_A = 1.5, 0.06 / 1.80
"""Friction of an XM430-W350 at a pad on a link of 60 mm in N, and its current in A for 1 N."""


def standing(velocity_rad_s: float, motor_rad_s=0.0, current_a=-0.1) -> ServoFeedback:
    servo = make_servo(angle_rad=0.1, velocity_rad_s=velocity_rad_s, next_rad_s=velocity_rad_s)
    servo = replace(servo, motor_rad_s=motor_rad_s, current_a=current_a)
    return make_state(servos=tuple(replace(s, servo_id=i) for i, s in enumerate((servo,) * 2, 1)))


GOOD = ServoGoal(angle_rad=0.09, current_a=0.2)


@pytest.mark.parametrize(
    ("goal", "age_s", "says"),
    [
        (GOOD._replace(current_a=0.9), 0.0, r"goal current 0\.900"),
        (GOOD._replace(current_a=-0.1), 0.0, "from 0 to"),
        (GOOD._replace(angle_rad=0.05, current_a=0.7), 0.0, "force_max_n is 15"),
        (GOOD._replace(angle_rad=1.4), 0.0, "goal angle"),
        (GOOD, 0.5, r"feedback is 0\.500 s old"),
    ],
)
def test_the_limits_stand_beside_the_write(goal: ServoGoal, age_s: float, says: str) -> None:
    writer, state = make_writer(), standing(velocity_rad_s=0.0)
    writer.check([GOOD, GOOD], state)
    writer._clock.sleep(age_s)
    with pytest.raises(BusUnreliable if age_s else LimitExceeded, match=says):
        writer.check([GOOD, goal], state)


def test_a_finger_past_its_end_may_stay_where_it_was_read_one_count_before() -> None:
    writer, count_rad = make_writer(), PAIR.servos[0].servo_model.rad_per_pulse
    past = replace(make_servo(angle_rad=1.4), velocity_rad_s=0.0)
    state = make_state(servos=(past, replace(past, servo_id=2)))
    stays, opens = (GOOD._replace(angle_rad=1.4 + n * count_rad) for n in (1, 2))
    writer.check([stays, stays], state)
    with pytest.raises(LimitExceeded, match="goal angle"):
        writer.check([opens, opens], state)


def test_a_force_above_the_cap_counts_where_it_is_valid_or_more_and_while_it_is_young() -> None:
    writer, state = make_writer(), standing(velocity_rad_s=0.0)
    too_much = ForceSample(t_s=state.t_s, force_n=(20.0, 20.0), valid=False)
    writer.note_force(too_much)
    assert writer.newest_force is None
    writer.note_force(replace(too_much, at_least=True))
    with pytest.raises(ForceAboveCap):
        writer.check([GOOD, GOOD], state)
    writer._clock.sleep(2.0 * PAIR.force_stale_s)
    writer.check([GOOD, GOOD], replace(state, t_s=writer._clock.monotonic()))


@pytest.mark.parametrize(("pauses", "above"), [(0.5, True), (2.0, False)])
def test_a_force_of_before_a_pause_is_no_part_of_the_present_mean(pauses, above) -> None:
    writer, before = make_writer(), ForceSample(t_s=0.0, force_n=(60.0, 60.0))
    writer.note_force(before)
    writer.note_force(replace(before, t_s=pauses * PAIR.force_stale_s, force_n=(0.0, 0.0)))
    assert writer.force_is_too_high() is above


@pytest.mark.parametrize(
    ("goal", "drive_n"),
    [
        # 1.041 times what is asked for, 1.5 N for the mass, and the friction.
        ({"setpoint_n": 4.0}, 4.163 + 1.5 + FRICTION_N),
        ({"setpoint_n": 8.0}, 8.327 + 1.5 + FRICTION_N),
        ({"setpoint_n": 14.2}, 0.95 * 15.0 / 1.041 + 0.82 * FRICTION_N),
        # Fingers that press on nothing: below the cap, with the least friction.
        ({}, 13.5 / 1.041 + 0.82 * FRICTION_N),
    ],
)
def test_no_more_current_is_written_than_the_force_that_is_asked_for_needs(goal, drive_n) -> None:
    """Whatever the pads show: no sample of them is there."""
    state = standing(velocity_rad_s=0.0)
    writer = make_writer(replace(PAIR, current_max_a=1.0))
    for angle_rad in (0.05, 0.05, 0.05, 0.05, 0.1):
        rest = ServoGoal(angle_rad=angle_rad, current_a=0.1)
        pushes = ServoGoal(angle_rad=angle_rad, current_a=0.66, rest=rest, **goal)
        writer.write([pushes] * 2, state)
    pushed_a, *steady_a, again_a, still_a = (
        [0.00269 * raws[0] for raws in write.args[0].values()]
        for write in writer._bus.sync_write.call_args_list
    )
    assert steady_a == [[pytest.approx(drive_n * ONE_N_A, abs=0.004)] * 2] * 2
    assert still_a == [pytest.approx(0.66, abs=0.003)] * 2
    # A push against friction at rest lasts one period of three.
    most_n = min(drive_n + 1.5 * FRICTION_N, 0.95 * 15.0 / 1.041 + 0.82 * FRICTION_N)
    if "setpoint_n" in goal:
        assert pushed_a == again_a == [pytest.approx(most_n * ONE_N_A, abs=0.004)] * 2


def test_goals_that_stay_swing_from_the_measured_force_to_below_the_cap() -> None:
    writer, asked = make_writer(), [ServoGoal(angle_rad=0.05, current_a=0.6)] * 2
    writer.note_force(ForceSample(t_s=1.0, force_n=(1.0, 2.0)))
    for goal in writer.bounded(asked, standing(velocity_rad_s=0.0), final=True):
        swings_n = 0.5 * (0.9 * PAIR.force_max_n + 2.0)
        assert goal.current_a == pytest.approx((swings_n + FRICTION_N) * ONE_N_A, rel=0.02)


@pytest.mark.parametrize("shares", [(1.0, 0.0), (0.0, 1.0)], ids=["position", "motor"])
def test_fingers_that_press_keep_a_speed_that_goes_by_no_pad(shares) -> None:
    """Pads that stand at 0.6 N would allow 30 mm/s. Position or motor shows the speed."""
    writer = make_writer()
    writer.note_force(ForceSample(t_s=0.0, force_n=(0.6, 0.6)))
    fast, slow = (standing(*(share * -m_s / 0.06 for share in shares)) for m_s in (0.025, 0.012))
    asked = [ServoGoal(angle_rad=0.05, current_a=0.2, setpoint_n=6.0)] * 2
    assert all(goal.angle_rad >= 0.1 for goal in writer.bounded(asked, fast))
    assert writer.bounded(asked, slow) == tuple(asked)
    # A motor at rest also seems to run where its current reads 0.
    assert writer.bounded(asked, standing(0.0, motor_rad_s=-0.5, current_a=0.0)) == tuple(asked)


@pytest.mark.parametrize(("friction_sd", "keeps"), [(0.05, True), (0.7, False)])
def test_known_friction_brakes_a_finger_that_is_slightly_too_fast(
    friction_sd: float, *, keeps: bool
) -> None:
    usual = DriveCharacteristic.catalogue(PAIR.servos[0].servo_model)
    stiff = replace(usual, breakaway_a=0.4, friction_sd=friction_sd)
    drives = Drives({servo.servo_id: stiff for servo in PAIR.servos})
    writer, asked = make_writer(PAIR, drives), [ServoGoal(angle_rad=0.05, current_a=0.6)] * 2
    limit = impact_limit(Mechanics(PAIR, LINKAGE, drives), (0.1, 0.1))
    most_m_s = max(limit.pad_speed_m_s(), 0.5 * SLOWEST_M_S)
    braked = writer.bounded(asked, standing(velocity_rad_s=-(most_m_s / 0.0597 + 0.2)))
    if keeps:
        assert all(goal.angle_rad == 0.05 and 0.1 < goal.current_a < 0.4 for goal in braked)
    else:
        assert all(goal.angle_rad == 0.1 for goal in braked)


@pytest.mark.parametrize(("motor_rad_s", "shows"), [(0.0, True), (-0.5, False)])
def test_a_finger_shows_its_friction_only_if_its_motor_stands_too(motor_rad_s, *, shows) -> None:
    writer, still = make_writer(replace(PAIR, current_max_a=1.0), Drives()), standing(0.0)
    asked = [ServoGoal(angle_rad=0.05, current_a=0.9)] * 2
    before_a = writer.bounded(asked, still)[0].current_a
    servos = standing(0.0, motor_rad_s).servos
    pressing = tuple(replace(servo, current_a=-0.6) for servo in servos)
    writer.bounded(asked, replace(still, servos=pressing))
    assert (writer.bounded(asked, still)[0].current_a > before_a) == shows
