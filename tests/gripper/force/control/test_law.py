"""The law of the force alone, on a finger with mass, stiction and a spring."""

import random
from collections.abc import Sequence
from dataclasses import replace
from statistics import median

import pytest

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import LimitExceeded
from gripper.force.control.grip_control import GIVE_RAD, DriveGoals
from gripper.force.control.law import ForceLaw, ForcePlan
from gripper.force.control.observer import GripObserver
from gripper.force.estimates.grip import StiffnessEstimate
from gripper.mechanics.transmission import Mechanics, Transmission
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.state import ServoFeedback
from tests.gripper.force.grips import (
    LINKAGE,
    PERIOD_S,
    STATE,
    STIFFNESS_N_M,
    make_grip,
    make_moment,
)

MECHANICS = Mechanics(GripperSettings(), LINKAGE)
PATHS = MECHANICS.transmissions(STATE.angles_rad)
"""Gearings with Coulomb friction alone."""
DRIVE = PATHS[0].drive
NOISE_N = 0.1


class Finger:
    """A mass that friction brakes and a spring pushes back, in steps of 0.1 ms.

    The drive follows that of the law with a time constant of 3 ms.
    """

    def __init__(self, path: Transmission, mass_kg: float, force_n: float, stiction: float) -> None:
        self.path, self.mass_kg, self.stiction = path, mass_kg, stiction
        self.force_n = self.drive_n = force_n
        self.speed_m_s = self.way_m = 0.0

    def drive(self, drive_n: float) -> None:
        step_s = 1e-4
        for _ in range(round(PERIOD_S / step_s)):
            self.drive_n += (drive_n - self.drive_n) * step_s / 0.003
            push_n, closing_n = self.drive_n - self.force_n, self.path.friction_n
            opening_n = self.force_n - self.path.yielding_n(self.force_n)
            more_n = (self.stiction - 1.0) * closing_n
            if self.speed_m_s == 0.0 and -opening_n - more_n <= push_n <= closing_n + more_n:
                continue
            closes = (self.speed_m_s or push_n) > 0.0
            before_m_s = self.speed_m_s
            braked_n = push_n - (closing_n if closes else -opening_n)
            self.speed_m_s += braked_n / self.mass_kg * step_s
            if before_m_s * self.speed_m_s < 0.0:
                self.speed_m_s = 0.0
            self.way_m += self.speed_m_s * step_s
            self.force_n += STIFFNESS_N_M * self.speed_m_s * step_s


class Grip:
    """The law on a finger, one period after the other."""

    def __init__(
        self, force_n: float, *, stiction: float = 1.6, drive: DriveCharacteristic = DRIVE
    ) -> None:
        self.grip = make_grip(force_n)
        for servo in self.grip.settings.servos:
            self.grip.mechanics.drives.put(servo.servo_id, drive)
        self.law = ForceLaw(self.grip, 0.0)
        path = Transmission(drive, PATHS[0].radius_m)
        self.finger = Finger(path, self.law.observer.mass_kg, force_n, stiction)
        self.random, self.periods, self.gain, self.reads = random.Random(3), 0, 1.0, 1.0

    def follow(self, setpoints_n: Sequence[float], *, may_open=True, end_n=0.0) -> list[float]:
        """Follow set-points, by default to their end; return the force after each period in N."""
        forces_n = []
        for setpoint_n in setpoints_n:
            now_s = self.periods * PERIOD_S
            sample = self.gain * self.finger.force_n + self.random.gauss(0.0, NOISE_N)
            drive_n, closed_m = self.reads * self.finger.drive_n, 2.0 * self.finger.way_m
            moment = make_moment(now_s, sample, closed_m=closed_m, drive_n=drive_n)
            self.grip.setpoint_n, last_n = setpoint_n, end_n or setpoints_n[-1]
            self.grip.drive_n = self.law.step(moment, last_n, may_open=may_open)
            self.finger.drive(self.grip.drive_n)
            forces_n.append(self.finger.force_n)
            self.periods += 1
        return forces_n


def ramp(start_n: float, end_n: float, rate_n_s: float, hold_s: float = 0.5) -> list[float]:
    steps = round(abs(end_n - start_n) / rate_n_s / PERIOD_S)
    change = [start_n + (end_n - start_n) * (i + 1) / steps for i in range(steps)]
    return change + [end_n] * round(hold_s / PERIOD_S)


LOSSY = replace(DRIVE, falling_a_nm=0.5 * DRIVE.rising_a_nm, yielding_share=0.8)
GEARINGS = {"rigid": DRIVE, "lossy": LOSSY}


@pytest.mark.parametrize("gearing", GEARINGS)
@pytest.mark.parametrize(
    ("start_n", "end_n", "rate_n_s"),
    [(1.0, 6.0, 3.0), (1.0, 6.0, 20.0), (1.0, 6.0, 40.0), (6.0, 2.0, 3.0), (6.0, 2.0, 20.0)],
)
def test_the_force_follows_a_ramp_and_holds(start_n, end_n, rate_n_s, gearing) -> None:
    grip, setpoints_n = Grip(start_n, drive=GEARINGS[gearing]), ramp(start_n, end_n, rate_n_s)
    forces_n = grip.follow(setpoints_n)
    assert max((1.0 if end_n > start_n else -1.0) * (force_n - end_n) for force_n in forces_n) < 0.6
    assert forces_n[-60:] == pytest.approx([end_n] * 60, abs=0.3)
    if rate_n_s == 3.0:
        assert forces_n == pytest.approx(setpoints_n, abs=0.6)


@pytest.mark.parametrize("may_open", [True, False])
def test_fingers_beyond_the_touch_are_not_pushed_open(may_open) -> None:
    forces_n = Grip(4.0, stiction=1.0).follow([3.0] * 200, may_open=may_open)
    assert forces_n[-1] == pytest.approx(3.0 if may_open else 4.0, abs=0.3)


def test_pushes_show_the_stiction_and_the_next_grip_begins_with_it() -> None:
    grip = Grip(1.0, stiction=1.9)
    grip.follow(ramp(1.0, 4.0, 3.0))
    assert 1.6 < grip.grip.mechanics.drives.stiction <= 2.0


def test_the_drive_of_a_hold_balances_the_force() -> None:
    drives_n = []
    for seed in range(9):
        grip = Grip(1.0)
        grip.random.seed(seed)
        grip.follow(ramp(1.0, 5.0, 10.0, hold_s=1.0))
        drives_n.append(grip.grip.drive_n)
    assert median(drives_n) == pytest.approx(5.0, abs=0.5)
    assert max(drives_n) < 5.0 + PATHS[0].friction_n


@pytest.mark.parametrize("reads", [-1.0, 0.0, 0.3, 1.7])
def test_a_current_that_is_read_wrongly_in_a_fall_changes_no_force(reads) -> None:
    grip, setpoints_n = Grip(8.0), ramp(8.0, 4.0, 20.0)
    grip.follow(setpoints_n[:20], end_n=4.0)
    for grip.reads, part in ((reads, setpoints_n[20:26]), (1.0, setpoints_n[26:])):
        assert grip.follow(part) == pytest.approx(part, abs=1.0)


def test_the_same_sample_corrects_only_once() -> None:
    observer = GripObserver(make_grip(1.0), 0.0)
    sample = ForceSample(t_s=0.1, force_n=(1.5, 1.5), noise_n=0.1)
    observer.measure(make_moment(0.1, sample), sample)
    once_n = observer.force_n
    observer.measure(make_moment(0.105, sample), sample)
    assert 1.0 < once_n == pytest.approx(observer.force_n, abs=1e-3)


@pytest.mark.parametrize(("speed_m_s", "closed_m"), [(0.0, 0.6e-3), (0.01, 2e-3)])
def test_a_position_that_leaps_is_no_way_and_makes_the_force_uncertain(speed_m_s, closed_m) -> None:
    observer = GripObserver(make_grip(2.0), 0.0)
    observer.break_loose(speed_m_s)
    observer.predict(PERIOD_S, 2.0, 0.0, (3.0, 3.0))
    predicted_n = observer.force_n
    observer.measure(make_moment(PERIOD_S, closed_m=closed_m), None)
    assert observer.force_n == predicted_n
    assert observer.force_sd_n > 1.0


@pytest.mark.parametrize("force_n", [1.0, 6.0])
def test_a_plan_never_passes_its_set_point_and_ends_at_rest(force_n) -> None:
    plan, end_n = ForcePlan(force_n, force_n), 4.0
    sign = 1.0 if end_n > force_n else -1.0
    for setpoint_n in ramp(force_n, end_n, 20.0):
        before_n_s = plan.rate_n_s
        plan.step(PERIOD_S, setpoint_n, end_n, most_n_s=100.0, most_n_s2=800.0)
        assert sign * plan.force_n <= sign * setpoint_n + 0.05
        assert sign * (plan.rate_n_s - before_n_s) <= 800.0 * PERIOD_S + 1e-9
    assert plan.force_n == pytest.approx(end_n, abs=1e-3)
    assert plan.rate_n_s == pytest.approx(0.0, abs=0.5)


def test_pads_that_do_not_follow_the_current_are_a_fault_and_no_reason_to_push() -> None:
    grip = Grip(1.0)
    grip.gain = 0.2
    with pytest.raises(LimitExceeded, match=r"disagree by -.* N, more than .* N"):
        grip.follow(ramp(1.0, 14.0, 10.0, hold_s=3.0))


@pytest.mark.parametrize("setpoints_n", [[3.0] * 70, ramp(3.0, 13.0, 20.0)])
def test_a_zero_that_jumps_is_a_fault_and_moves_nothing(setpoints_n) -> None:
    grip = Grip(3.0)
    before_n = grip.follow(setpoints_n[:20], end_n=setpoints_n[-1])[-1]
    grip.gain = 2.0
    with pytest.raises(LimitExceeded, match=r"their zero has jumped, or .* the grip kept"):
        grip.follow(setpoints_n[20:])
    assert grip.finger.force_n == pytest.approx(before_n, abs=0.05)


def test_a_force_that_was_predicted_wrongly_has_not_jumped() -> None:
    grip = Grip(3.0)
    grip.follow([3.0] * 50)
    observer = grip.law.observer
    before_n_m = observer.stiffness_n_m
    observer.force_n -= 2.0
    observer._forces.shift(-2.0)
    grip.follow([3.0] * 50)
    assert observer.force_n == pytest.approx(3.0, abs=0.3)
    assert 0.25 * before_n_m < observer.stiffness_n_m < 2.0 * before_n_m


# -- Goals that make a driving force: their side, and how far they may open ------------------------


def standing(angle_rad: float) -> ServoFeedback:
    servos = tuple(replace(servo, angle_rad=angle_rad) for servo in STATE.servos)
    return replace(STATE, servos=servos, aperture_m=LINKAGE.aperture_m((angle_rad,) * 2))


def first_goal(goals: DriveGoals, drive_n: float, angle_rad: float) -> tuple[float, float]:
    goals._grip.drive_n = drive_n
    return goals.goals(standing(angle_rad))[0][:2]


def test_the_side_of_the_goal_is_the_sign_of_the_drive() -> None:
    goals = DriveGoals(make_grip(touch_m=standing(0.1).aperture_m), standing(0.1))
    closing_rad, closing_a = first_goal(goals, 4.0, 0.09)
    opening_rad, opening_a = first_goal(goals, -4.0, 0.09)
    assert closing_rad < 0.09 < opening_rad
    assert closing_a == pytest.approx(opening_a)
    for drive_n in (100.0, -100.0):
        path = MECHANICS.transmissions((0.09, 0.09))[0]
        most_a = path.pressing_current_a(GripperSettings().force_max_n)
        assert first_goal(goals, drive_n, 0.09)[1] == pytest.approx(most_a)


def test_no_finger_pushes_the_other_aside_with_a_force_that_the_cap_does_not_allow() -> None:
    """With another friction each servo has another share of a push; the caps leave them equal."""
    grip, state = make_grip(touch_m=standing(0.1).aperture_m), standing(0.09)
    settings, drives, servo = grip.settings, grip.mechanics.drives, grip.settings.servos[0]
    drive = drives.of(servo)
    light = {"coulomb_a": 0.3 * drive.coulomb_a, "breakaway_a": 0.3 * drive.breakaway_a}
    drives.put(servo.servo_id, replace(drive, **light))
    goals = DriveGoals(grip, standing(0.1))
    path = grip.mechanics.transmissions(state.angles_rad)[0]
    for sign in (1.0, -1.0):
        grip.balance_n = grip.drive_n = sign * 2.0 * settings.force_max_n
        first, second = goals.goals(state)
        assert first.current_a == pytest.approx(second.current_a, rel=0.01)
        assert 0.0 < path.n_per_a * first.current_a < 2.0 * settings.force_max_n


def test_a_position_that_drifts_open_does_not_take_a_closing_goal_with_it() -> None:
    goals = DriveGoals(make_grip(touch_m=standing(0.1).aperture_m), standing(0.1))
    before_rad, _ = first_goal(goals, 4.0, 0.09)
    assert first_goal(goals, 4.0, 0.2)[0] == pytest.approx(before_rad, abs=1e-3)


def test_no_finger_is_driven_open_beyond_the_touch() -> None:
    goals = DriveGoals(make_grip(touch_m=standing(0.1 + 0.5 * GIVE_RAD).aperture_m), standing(0.1))
    assert first_goal(goals, -30.0, 0.1)[0] == pytest.approx(0.1 + GIVE_RAD)
    assert goals.may_open
    beyond_rad = 0.1 + 0.6 * GIVE_RAD
    assert first_goal(goals, -30.0, beyond_rad)[0] == pytest.approx(beyond_rad)
    assert not goals.may_open
    first_goal(goals, -30.0, 0.1)
    assert goals.may_open


def test_an_opening_goal_keeps_the_part_after_the_first_ramp() -> None:
    goals = DriveGoals(make_grip(8.0, standing(0.2).aperture_m), standing(0.2))
    goals._grip.stiffness.stiffness_n_m = 5e3
    assert first_goal(goals, -30.0, 0.1)[0] > 0.13
    goals.keeps = True
    opened_rad, _ = first_goal(goals, -30.0, 0.1)
    opened_m = LINKAGE.aperture_m((opened_rad,) * 2) - standing(0.1).aperture_m
    assert 0.6 * 8.0 < 5e3 * opened_m < 8.0


# -- Stiffness of a part by its samples ------------------------------------------------------------


def pressed(n_m: float, rate_hz: float, noise_n: float, seed: int = 0) -> StiffnessEstimate:
    """Return the estimate of a part that the fingers have pressed with 1.2 N or more, by counts."""
    estimate, generator = StiffnessEstimate(MECHANICS), random.Random(seed)
    for i in range(100):
        now_s = 0.005 * i
        way_m = max(2.4, 1e-4 * n_m) * now_s / n_m
        if i % round(200.0 / rate_hz) == 0:
            force_n = tuple(n_m * way_m + generator.gauss(0.0, noise_n) for _ in range(2))
            sample = ForceSample(t_s=now_s, force_n=force_n, lag_s=0.0, noise_n=0.7 * noise_n)
        counted_m = round(way_m / estimate.step_m) * estimate.step_m
        estimate.push(make_moment(now_s, sample, closed_m=counted_m))
    return estimate


def test_the_noise_of_fast_samples_is_no_stiffness() -> None:
    assert pressed(200.0, 50.0, 0.0).stiffness_n_m == pytest.approx(200.0, rel=0.05)
    fast_n_m = [pressed(200.0, 200.0, 0.15, seed).stiffness_n_m for seed in range(7)]
    assert median(fast_n_m) == pytest.approx(200.0, rel=0.35)


@pytest.mark.parametrize("rate_hz", [50.0, 200.0])
@pytest.mark.parametrize("n_m", [1000.0, 4000.0, 15000.0])
def test_the_true_stiffness_is_within_its_bounds_but_for_the_noise(n_m, rate_hz) -> None:
    for seed in range(5):
        least_n_m, most_n_m = pressed(n_m, rate_hz, 0.15, seed).bounds_n_m
        # Two standard deviations of the noise are exceeded sometimes.
        assert 0.5 * least_n_m <= n_m <= 2.0 * most_n_m
        assert n_m < 1e4 or least_n_m > 1e3, "a hard part is not soft"


def test_what_follows_a_ramp_is_as_stiff_as_its_travel() -> None:
    (estimate := pressed(4000.0, 50.0, 0.0)).end()
    before_n_m = estimate.bounds_n_m
    estimate.allow_harder()
    estimate.end()
    assert estimate.bounds_n_m == before_n_m
