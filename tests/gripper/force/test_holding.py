"""Holding: slips, unequal fingers, heat, and the way out of too much force."""

import random

import pytest

from benchmarks.performance._force_plant import Rig, Truth
from benchmarks.performance.force_ramps import PARTS
from gripper.errors import ForceImbalance, PartLost, PartSlipped
from gripper.force.ramp import ForceRamp
from gripper.force.supervision.slip import SlipWatch
from gripper.force_sensor import ForceSample
from gripper.kinematics import ParallelLinkage
from gripper.outcome import GraspResult
from gripper.servos.goals import GoalGuard
from gripper.settings import ForceLoopSettings, GripperSettings, ServoSettings
from gripper.state import GripperPhase

RAMP = ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=0.2)
SETTINGS = GripperSettings(servos=(ServoSettings(servo_id=1),))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_quiet_hold_with_a_noisy_sensor_shows_no_slip(make_cell, seed) -> None:
    cell = make_cell(noise_n=0.3, seed=seed)
    cell.hold_part(RAMP)
    cell.gripper.hold(6.0)
    assert cell.force_n == pytest.approx(4.0, abs=0.3)


def test_a_force_on_foam_that_creeps_stays_within_its_aim_for_a_long_hold() -> None:
    """Friction keeps small errors; after 1 s of a hold its drive is given back beside."""
    truth = Truth(kt_error=0.1, friction_error=-0.15, seed=103)
    part = PARTS["cork, 5 N/mm"]
    rig = Rig(part, truth, 0.2, ForceLoopSettings(), rate_hz=500.0, further_truths=True)
    quality = rig.grasp(4.0, 3.0)
    assert not quality.lost
    assert max(quality.holding_n, quality.overshoot_n) <= 0.15


@pytest.mark.parametrize("seed", [0, 2, 5])
def test_a_correction_downwards_does_not_shoot_beyond_where_friction_is_less_than_known(
    make_cell, seed
) -> None:
    cell = make_cell(rate_hz=200.0, kt_error=0.09, friction_error=-0.15, seed=seed)
    cell.hold_part(ForceRamp.linear(6.0, rate_n_s=20.0))
    cell.gripper.hold(0.5)
    cell.sensor.gain = 1.06
    corrected_n = 6.0 / cell.sensor.gain
    cell.least_n = 6.0
    cell.gripper.hold(1.5)
    assert cell.force_n == pytest.approx(corrected_n, abs=0.15)
    assert cell.least_n > corrected_n - 0.2


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_part_met_with_more_than_the_ramp_asks_for_is_pressed_no_harder(make_cell, seed) -> None:
    cell = make_cell(
        rate_hz=200.0,
        kt_error=0.09,
        friction_error=-0.15,
        seed=seed,
        noise_n=0.1,
        approach_speed_m_s=0.06,
        approach_force_n=2.0,
    )
    forces_n: list[float] = []
    cell.gripper.start()
    ramp = ForceRamp.linear(2.0, rate_n_s=10.0)
    cell.gripper.grasp(ramp, lambda c: forces_n.append(cell.force_n) if c.setpoint_n else None)
    assert 2.2 < forces_n[0] == max(forces_n)


def test_a_sudden_drop_is_a_slip_within_a_tenth_of_a_second() -> None:
    watch = SlipWatch(SETTINGS)
    found_s = None
    for i in range(400):
        t_s = 0.005 * i
        force_n = 4.0 if t_s < 1.0 else 3.0
        sample = ForceSample(t_s=0.02 * (i // 4), force_n=(force_n, force_n))
        if found_s is None and watch.check(t_s, 0.01, sample, setpoint_n=4.0) is not None:
            found_s = t_s
    assert found_s is not None
    assert 1.0 < found_s < 1.1


def test_fingers_that_close_after_the_part_show_a_slip() -> None:
    watch = SlipWatch(SETTINGS)
    told = [
        watch.check(
            0.005 * i,
            0.01 - 4e-6 * i,
            ForceSample(t_s=0.005 * i, force_n=(4.0, 4.0)),
            setpoint_n=4.0,
        )
        for i in range(600)
    ]
    first = next(i for i, text in enumerate(told) if text)
    assert 1.5 < 4e-3 * (first - 60) < 1.6
    assert "closed by 1.5" in str(told[first])


def test_a_finger_that_pushes_alone_freezes_both(cell, monkeypatch) -> None:
    cell.hold_part(RAMP)
    measure = cell.sensor.measure
    monkeypatch.setattr(
        cell.sensor, "measure", lambda now_s, force_n: measure(now_s, (force_n[0], 0.2))
    )
    begun_s = cell.clock.monotonic()
    with pytest.raises(ForceImbalance, match="both are frozen"):
        cell.gripper.hold(2.0)
    assert cell.clock.monotonic() - begun_s < 0.5
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT
    assert cell.force_n > 3.0


def test_a_warm_servo_gets_less_current_before_it_is_too_hot(make_cell) -> None:
    assert SETTINGS.current_cap_a(60.0) == SETTINGS.current_max_a
    assert SETTINGS.current_cap_a(65.0) == pytest.approx(0.75 * SETTINGS.current_max_a)
    assert SETTINGS.current_cap_a(90.0) == pytest.approx(0.5 * SETTINGS.current_max_a)
    cell = make_cell(current_max_a=0.5, temperature_max_c=70.0)
    cell.gripper.start()
    for knob in cell.knobs:
        knob.overheat(69.0)
    currents_a: list[float] = []
    ramp = ForceRamp.linear(9.0, rate_n_s=10.0)
    outcome = cell.gripper.grasp(ramp, lambda c: currents_a.append(c.goal_current_a))
    assert outcome.result is GraspResult.FORCE_NOT_REACHED
    assert max(currents_a) < 0.3
    assert cell.gripper.state is GripperPhase.HOLDING


def test_the_step_down_from_too_much_force_is_as_configured(make_cell) -> None:
    cell = make_cell(force_max_n=6.0, over_force_share=0.8)
    cell.hold_part(RAMP)
    written: list[int] = []
    cell.sensor.gain = 2.5
    with pytest.raises(ValueError, match="force_max_n is 6"):
        cell.gripper.hold(1.0, lambda _: written.append(cell.register(0, "goal_current")))
    assert abs(cell.register(0, "goal_current")) == pytest.approx(0.8 * abs(written[-1]), abs=2)


def pressed(t_s: float, x_m: float, *, noise_m: float, force_n: float = 5.0) -> ForceSample:
    return ForceSample(
        t_s=t_s, force_n=(force_n, force_n), centre_m=(x_m, 0.0), centre_noise_m=noise_m
    )


def slid_m(period_s: float, noise_m: float, *, speed_m_s: float, force_n: float = 5.0) -> float:
    """Return how far a part has slid when that is reported; 1 m where it never is."""
    watch, draw = SlipWatch(SETTINGS), random.Random(5)
    for i in range(round(4.0 / period_s)):
        t_s = period_s * i
        x_m = speed_m_s * max(0.0, t_s - 1.0)
        sample = pressed(t_s, x_m + draw.gauss(0.0, noise_m), noise_m=noise_m, force_n=force_n)
        if watch.check(t_s, 0.01, sample, setpoint_n=force_n):
            return x_m
    return 1.0


@pytest.mark.parametrize(("period_s", "noise_m"), [(0.02, 0.0001), (0.005, 0.00025)])
def test_a_part_that_slides_along_the_pads_is_a_slip(period_s, noise_m) -> None:
    assert 0.0005 < slid_m(period_s, noise_m, speed_m_s=0.02) < 0.0012


def test_the_noisier_the_centre_the_farther_is_a_slide() -> None:
    assert 0.002 < slid_m(0.02, 0.0005, speed_m_s=0.02) < 0.004
    assert slid_m(0.02, 0.0005, speed_m_s=0.0) == 1.0


def test_a_slow_slide_is_reported_at_the_largest_way_that_is_allowed() -> None:
    assert 0.0014 < slid_m(0.02, 0.0001, speed_m_s=0.001) < 0.0017


def test_a_part_taken_away_in_the_ramp_is_lost_with_the_third_frame(cell) -> None:
    cell.gripper.start()
    take = cell.once(lambda: setattr(cell.part, "present", False), at_n=3.0)
    outcome = cell.gripper.grasp(ForceRamp.linear(8.0, rate_n_s=5.0), take)
    assert outcome.result is GraspResult.PART_LOST
    assert cell.gripper.state is GripperPhase.IDLE
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.09
    stopped_m = cell.mechanics.aperture_m
    cell.clock.sleep(1.0)
    assert stopped_m - cell.mechanics.aperture_m < 0.003


@pytest.mark.parametrize("final_n", [3.0, 8.0])
def test_fast_force_shows_a_part_taken_away_at_once(make_cell, final_n) -> None:
    cell = make_cell(rate_hz=333.0, noise_n=0.3)
    cell.hold_part(ForceRamp.linear(final_n, rate_n_s=10.0))
    with pytest.raises(PartLost):
        cell.gripper.hold(1.0, cell.once(lambda: setattr(cell.part, "present", False), in_s=0.4))
    assert cell.clock.monotonic() - cell.acted_s[0] < 0.017


@pytest.mark.parametrize("force_n", [0.7, 1.5])
def test_a_light_part_is_not_lost_in_the_noise_of_single_scans(make_cell, force_n) -> None:
    cell = make_cell(rate_hz=333.0, noise_n=0.35, slip_drop_n=20.0)
    cell.gripper.start()
    assert cell.gripper.grasp(ForceRamp.linear(force_n, rate_n_s=2.0)).contact_t_s is not None
    cell.gripper.hold(5.0)


def test_a_long_hold_at_a_level_of_the_ramp_is_watched_too(cell) -> None:
    cell.gripper.start()

    def slip(cycle) -> None:
        if cycle.level is not None:
            cell.part.width_m -= 1e-5

    with pytest.raises(PartSlipped):
        cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=5.0, hold_s=5.0), slip)
    assert cell.gripper.state is GripperPhase.HELD_AFTER_FAULT


def test_force_beyond_the_set_point_that_is_given_back_is_no_slip() -> None:
    watch = SlipWatch(SETTINGS)
    for i in range(400):
        t_s = 0.005 * i
        sample = ForceSample(t_s=0.02 * (i // 4), force_n=(4.4, 4.4) if t_s < 1.0 else (3.1, 3.1))
        assert watch.check(t_s, 0.01, sample, setpoint_n=3.0) is None


@pytest.mark.parametrize("stalls_s", [0.05, 0.15, 0.2])
def test_a_part_is_not_lost_because_the_loop_stalls(make_cell, stalls_s) -> None:
    # A force that overshoots in a stall comes back at once: that is no slip.
    cell = make_cell(
        force_stale_s=0.3, stall_max_s=0.25, watchdog_s=0.5, bus_loss_s=0.3, slip_drop_n=2.0
    )
    cell.gripper.start()
    periods = 0

    def stall(cycle) -> None:
        nonlocal periods
        periods += 1
        if periods % 40 == 0:
            cell.clock.sleep(stalls_s)

    assert cell.gripper.grasp(RAMP, stall).result is GraspResult.FORCE_REACHED
    cell.gripper.hold(1.5, stall)
    assert cell.force_n == pytest.approx(4.0, abs=0.5)


def test_a_part_is_not_lost_because_the_pads_say_nothing(make_cell) -> None:
    cell = make_cell(force_stale_s=0.3, watchdog_s=0.5)
    cell.gripper.start()

    def silence(cycle) -> None:
        cell.sensor.valid = not 2.0 < cycle.setpoint_n < 3.0

    outcome = cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=5.0), silence)
    assert outcome.result is GraspResult.FORCE_REACHED


@pytest.mark.parametrize(("over_n", "at_most_s"), [(0.8, 0.03), (3.0, 0.006)])
def test_the_cap_is_noticed_the_sooner_the_more_it_is_passed(over_n, at_most_s) -> None:
    draw = random.Random(4)
    guard = GoalGuard(SETTINGS, ParallelLinkage(link_m=0.06, n_servos=1))
    found_s = None
    for i in range(2200):
        t_s = 0.005 * i
        force_n = SETTINGS.force_max_n + (over_n if t_s > 10.0 else -0.5) + draw.gauss(0.0, 0.3)
        guard.note_force(
            ForceSample(t_s=t_s, force_n=(force_n, force_n), lag_s=0.0015, noise_n=0.21)
        )
        if found_s is None and guard.force_is_too_high():
            found_s = t_s
    assert found_s is not None
    assert 10.0 < found_s <= 10.0 + at_most_s
