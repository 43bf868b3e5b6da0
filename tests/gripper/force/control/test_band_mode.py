"""The mode of the friction band alone, on a quasi-static finger: an independent play model."""

import random
from typing import Any

import pytest

from gripper.errors import LimitExceeded
from gripper.force.control.band_mode import BandMode, arriving_n
from gripper.force.control.motion_mode import MotionMode
from gripper.force.control.period import Mode
from gripper.values.force_sensor import ForceSample
from tests.gripper.force.grips import FRICTION_N, PERIOD_S, make_grip, make_period
from tests.marks import LONG


class Finger:
    """Grip force that moves only when the friction band pushes it; no inertia."""

    def __init__(self, friction_n: float, gain: float = 1.0, force_n: float = 1.0) -> None:
        self.friction_n = friction_n
        self.gain = gain
        self.force_n = force_n

    def drive(self, drive_n: float) -> float:
        centre_n = self.gain * drive_n
        low_n, high_n = centre_n - self.friction_n, centre_n + self.friction_n
        self.force_n = max(0.0, min(max(self.force_n, low_n), high_n))
        return self.force_n


class Loop:
    """The mode and its grip, one period after the other."""

    def __init__(self, force_n: float = 1.0) -> None:
        self.grip = make_grip(force_n)
        self.mode = BandMode(self.grip, 0.0)

    @property
    def drive_n(self) -> float:
        return self.grip.quiet_n

    def step(self, now_s: float, setpoint_n: float, sample: ForceSample, **changes: Any) -> float:
        # A quick loop leaves the errors of a hold to planned motions.
        changes = {"quick": False} | changes
        return self.mode.step(make_period(now_s, setpoint_n, sample, **changes))


def follow(
    loop: Loop,
    finger: Finger,
    setpoints_n: list[float],
    *,
    noise_n: float = 0.2,
    delay_steps: int = 6,
    start_s: float = 0.0,
    taper: bool = False,
    drive_max_n: float = 40.0,
) -> list[float]:
    generator = random.Random(5)
    samples = [ForceSample(t_s=start_s, force_n=(finger.force_n,) * 2)]
    forces_n = []
    for i, setpoint_n in enumerate(setpoints_n):
        now_s = start_s + i * PERIOD_S
        if i % 4 == 0:
            seen_n = finger.force_n + generator.gauss(0.0, noise_n)
            samples.append(ForceSample(t_s=now_s, force_n=(seen_n, seen_n)))
        known = [s for s in samples if s.t_s <= now_s - delay_steps * PERIOD_S] or samples[:1]
        drive_n = loop.step(now_s, setpoint_n, known[-1], drive_max_n=drive_max_n, taper=taper)
        forces_n.append(finger.drive(drive_n))
    return forces_n


def ramp(rate_n_s: float, end_n: float, hold_s: float, start_n: float = 1.0) -> list[float]:
    steps = round(abs(end_n - start_n) / rate_n_s / PERIOD_S)
    rise = [start_n + (end_n - start_n) * i / steps for i in range(steps)]
    return rise + [end_n] * round(hold_s / PERIOD_S)


@pytest.mark.slow
@pytest.mark.parametrize("rate_n_s", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("gain", [0.9, LONG(1.0), 1.1])
@pytest.mark.parametrize("friction_share", [0.8, LONG(1.0), 1.2])
def test_ramp_and_hold_without_overshoot(rate_n_s, gain, friction_share) -> None:
    finger = Finger(FRICTION_N * friction_share, gain)
    forces_n = follow(Loop(), finger, ramp(rate_n_s, 10.0, 2.0))
    assert max(forces_n) <= 10.5
    end_n = forces_n[-round(1.0 / PERIOD_S) :]
    assert all(abs(force_n - 10.0) <= 0.5 for force_n in end_n)


def test_held_drive_does_not_hunt() -> None:
    loop, finger = Loop(), Finger(1.15 * FRICTION_N)
    follow(loop, finger, ramp(5.0, 8.0, 1.0))
    drives: list[float] = []
    for i in range(20):
        follow(loop, finger, [8.0] * 40, start_s=10.0 + 0.2 * i)
        drives.append(loop.drive_n)
    assert max(drives) - min(drives) < 0.5


def test_the_way_down_turns_round_through_twice_the_friction() -> None:
    loop, finger = Loop(), Finger(FRICTION_N)
    follow(loop, finger, ramp(5.0, 10.0, 0.5))
    loaded_n = loop.drive_n
    forces_n = follow(loop, finger, ramp(5.0, 5.0, 0.1, start_n=10.0), start_s=3.0)
    assert loaded_n - loop.drive_n > 2 * FRICTION_N
    assert loop.drive_n < 5.0
    forces_n += follow(loop, finger, [5.0] * 300, start_s=6.0)
    assert forces_n[-1] == pytest.approx(5.0, abs=0.3)
    assert min(forces_n) >= 4.4


def test_less_friction_than_modelled_is_noticed_while_turning_round() -> None:
    loop, finger = Loop(), Finger(0.8 * FRICTION_N)
    follow(loop, finger, ramp(5.0, 10.0, 0.5))
    forces_n = follow(loop, finger, ramp(5.0, 5.0, 2.0, start_n=10.0), start_s=3.0)
    assert forces_n[-1] == pytest.approx(5.0, abs=0.5)
    assert min(forces_n) >= 4.0


def test_a_saturated_drive_winds_nothing_up() -> None:
    loop, finger = Loop(), Finger(FRICTION_N)
    follow(loop, finger, ramp(5.0, 10.0, 3.0), drive_max_n=10.0)
    assert finger.force_n == pytest.approx(10.0 - FRICTION_N, abs=0.01)
    assert loop.drive_n == pytest.approx(10.0, abs=1e-6)
    forces_n = follow(loop, finger, [6.0] * 300, start_s=9.0, drive_max_n=10.0)
    assert forces_n[-1] == pytest.approx(6.0, abs=0.35)


def test_fingers_that_lag_behind_are_not_driven_beyond_the_largest_drive() -> None:
    loop = Loop(6.0)
    for i in range(600):
        now_s = 0.005 * i
        sample = ForceSample(t_s=now_s, force_n=(6.0, 6.0))
        drive_n = loop.step(now_s, 12.0, sample, drive_max_n=10.0, speed_m_s=0.1)
        assert drive_n <= 10.0
    assert drive_n == pytest.approx(10.0)


def test_the_drive_never_pushes_open_by_more_than_friction_needs() -> None:
    loop, finger = Loop(3.0), Finger(FRICTION_N, force_n=3.0)
    follow(loop, finger, ramp(5.0, 0.6, 2.0, start_n=3.0))
    assert loop.drive_n >= -1.3 * FRICTION_N
    assert finger.force_n == pytest.approx(0.6, abs=0.4)


def test_a_long_hold_gives_back_what_friction_holds() -> None:
    loop, finger, rise = Loop(), Finger(FRICTION_N), ramp(5.0, 8.0, 0.5)
    follow(loop, finger, rise, noise_n=0.0)
    before_n, end_s = loop.drive_n, len(rise) * PERIOD_S
    forces_n = follow(loop, finger, [8.0] * 800, noise_n=0.0, start_s=end_s, taper=True)
    assert loop.drive_n < before_n - 0.5 * FRICTION_N
    assert all(abs(force_n - 8.0) < 0.4 for force_n in forces_n)


def test_a_sensor_that_does_not_see_the_force_is_a_fault_not_a_reason_to_push() -> None:
    loop = Loop()
    blind = Finger(FRICTION_N, gain=0.0, force_n=0.0)
    with pytest.raises(LimitExceeded, match="disagree"):
        follow(loop, blind, ramp(5.0, 8.0, 5.0), noise_n=0.0)
    assert loop.drive_n < 24.0


def test_the_same_sample_teaches_only_once() -> None:
    sample = ForceSample(t_s=0.1, force_n=(1.15, 1.15))
    biases_n = []
    for steps in (1, 50):
        loop = Loop()
        for i in range(steps):
            loop.step(0.1 + i * PERIOD_S, 1.0, sample)
        biases_n.append(loop.grip.estimate.bias_n)
    assert biases_n[0] == biases_n[1]
    assert 0.0 < biases_n[0] < 0.15


def share_learnt(rate_hz: float, noise_n: float) -> float:
    """Return how much of a step of the sensor's bias is learnt after 0.8 s, late in a hold."""
    loop = Loop()
    for i in range(1, 561):
        now_s = i * PERIOD_S
        t_s = int(now_s * rate_hz + 1e-6) / rate_hz
        grip_n = loop.grip.estimate.model_n + (0.1 if t_s > 2.0 else 0.0)
        sample = ForceSample(t_s=t_s, force_n=(grip_n, grip_n), lag_s=0.0, noise_n=noise_n)
        loop.step(now_s, 1.0, sample)
    return loop.grip.estimate.bias_n / 0.1


def test_fast_samples_teach_sooner_and_noisy_ones_later() -> None:
    frames, messages = share_learnt(50.0, 0.3), share_learnt(200.0, 0.25)
    assert 0.2 < frames < 0.5
    assert messages > 1.5 * frames
    assert share_learnt(200.0, 1.0) < frames


def test_the_force_arrives_without_a_knee_and_never_passes_the_set_point() -> None:
    forces_n, rates_n_s = [1.0], []
    for i in range(200):
        setpoint_n = min(4.0, 1.0 + 10.0 * 0.005 * (i + 1))
        forces_n.append(arriving_n(forces_n[-1], 0.005, setpoint_n, 4.0, 0.1))
        rates_n_s.append((forces_n[-1] - forces_n[-2]) / 0.005)
        assert forces_n[-1] <= setpoint_n + 1e-12
    assert forces_n == sorted(forces_n)
    assert max(rates_n_s) <= 10.0 + 1e-6
    assert forces_n[121] == pytest.approx(4.0, abs=0.03)
    assert forces_n[-1] == 4.0
    for i in range(200):
        forces_n.append(arriving_n(forces_n[-1], 0.005, max(2.0, 4.0 - 0.05 * i), 2.0, 0.1))
    assert forces_n[201:] == sorted(forces_n[201:], reverse=True)
    assert forces_n[-1] == 2.0


def test_the_band_goes_on_where_a_motion_ended_and_after_a_wait_where_it_was() -> None:
    loop = Loop()
    follow(loop, Finger(FRICTION_N), ramp(5.0, 6.0, 0.2))
    follow(loop, Finger(FRICTION_N, force_n=6.0), ramp(5.0, 4.0, 0.0, start_n=6.0), start_s=2.0)
    waited = make_period(3.0, 4.0, 4.0)
    loop.mode.enter(waited, Mode())
    assert not loop.mode._rising
    motion = MotionMode(loop.grip, 2.9, pad_n_m=1e4)
    motion.setpoint_n = 7.0
    loop.mode.enter(waited, motion)
    assert loop.mode._rising
    assert (loop.mode._setpoint_n, loop.mode._held_since_s) == (7.0, 2.9)
