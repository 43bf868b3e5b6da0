"""The force loop alone, on a quasi-static finger with friction: an independent play model."""

import random

import pytest

from gripper.errors import LimitExceeded
from gripper.force.controller import ForceController
from gripper.force_sensor import ForceSample
from gripper.settings import ForceLoopSettings

PERIOD_S = 0.005
FRICTION_N = 3.7


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


def follow(
    loop: ForceController,
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
        drive_n = loop.step(
            now_s,
            PERIOD_S,
            setpoint_n,
            known[-1],
            friction_n=FRICTION_N,
            drive_max_n=drive_max_n,
            taper=taper,
        )
        forces_n.append(finger.drive(drive_n))
    return forces_n


def ramp(rate_n_s: float, end_n: float, hold_s: float, start_n: float = 1.0) -> list[float]:
    steps = round(abs(end_n - start_n) / rate_n_s / PERIOD_S)
    rise = [start_n + (end_n - start_n) * i / steps for i in range(steps)]
    return rise + [end_n] * round(hold_s / PERIOD_S)


def new_loop(force_n: float = 1.0, **tuning: float) -> ForceController:
    return ForceController(ForceLoopSettings(**tuning), force_n=force_n, drive_n=force_n, now_s=0.0)


@pytest.mark.parametrize("rate_n_s", [1.0, 3.0, 10.0])
@pytest.mark.parametrize("gain", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("friction_share", [0.8, 1.0, 1.2])
def test_ramp_and_hold_without_overshoot(rate_n_s, gain, friction_share) -> None:
    finger = Finger(FRICTION_N * friction_share, gain)
    forces_n = follow(new_loop(), finger, ramp(rate_n_s, 10.0, 2.0))
    assert max(forces_n) <= 10.5
    end_n = forces_n[-round(1.0 / PERIOD_S) :]
    assert all(abs(force_n - 10.0) <= 0.5 for force_n in end_n)


def test_held_drive_does_not_hunt() -> None:
    loop, finger = new_loop(), Finger(1.15 * FRICTION_N)
    follow(loop, finger, ramp(5.0, 8.0, 1.0))
    drives: list[float] = []
    for i in range(20):
        follow(loop, finger, [8.0] * 40, start_s=10.0 + 0.2 * i)
        drives.append(loop.drive_n)
    assert max(drives) - min(drives) < 0.5


def test_the_way_down_turns_round_through_twice_the_friction() -> None:
    loop, finger = new_loop(), Finger(FRICTION_N)
    follow(loop, finger, ramp(5.0, 10.0, 0.5))
    loaded_n = loop.drive_n
    forces_n = follow(loop, finger, ramp(5.0, 5.0, 0.1, start_n=10.0), start_s=3.0)
    assert loaded_n - loop.drive_n > 2 * FRICTION_N
    assert loop.drive_n < 5.0
    forces_n += follow(loop, finger, [5.0] * 300, start_s=6.0)
    assert forces_n[-1] == pytest.approx(5.0, abs=0.3)
    assert min(forces_n) >= 4.4


def test_less_friction_than_modelled_is_noticed_while_turning_round() -> None:
    loop, finger = new_loop(), Finger(0.8 * FRICTION_N)
    follow(loop, finger, ramp(5.0, 10.0, 0.5))
    forces_n = follow(loop, finger, ramp(5.0, 5.0, 2.0, start_n=10.0), start_s=3.0)
    assert forces_n[-1] == pytest.approx(5.0, abs=0.5)
    assert min(forces_n) >= 4.0


def test_a_saturated_drive_winds_nothing_up() -> None:
    loop, finger = new_loop(), Finger(FRICTION_N)
    follow(loop, finger, ramp(5.0, 10.0, 3.0), drive_max_n=10.0)
    assert finger.force_n == pytest.approx(10.0 - FRICTION_N, abs=0.01)
    assert loop.drive_n == pytest.approx(10.0, abs=1e-6)
    forces_n = follow(loop, finger, [6.0] * 300, start_s=9.0, drive_max_n=10.0)
    assert forces_n[-1] == pytest.approx(6.0, abs=0.35)


def test_fingers_that_lag_behind_are_not_driven_beyond_the_largest_drive() -> None:
    loop = new_loop(6.0)
    for i in range(600):
        now_s = 0.005 * i
        drive_n = loop.step(
            now_s,
            0.005,
            12.0,
            ForceSample(t_s=now_s, force_n=(6.0, 6.0)),
            friction_n=FRICTION_N,
            drive_max_n=10.0,
            braking_n=-1.0,
        )
        assert drive_n <= 10.0
    assert drive_n == pytest.approx(10.0)


def test_the_drive_never_pushes_open_by_more_than_friction_needs() -> None:
    loop, finger = new_loop(3.0), Finger(FRICTION_N, force_n=3.0)
    follow(loop, finger, ramp(5.0, 0.6, 2.0, start_n=3.0))
    assert loop.drive_n >= -1.3 * FRICTION_N
    assert finger.force_n == pytest.approx(0.6, abs=0.4)


def test_a_long_hold_gives_back_what_friction_holds() -> None:
    loop, finger, rise = new_loop(), Finger(FRICTION_N), ramp(5.0, 8.0, 0.5)
    follow(loop, finger, rise, noise_n=0.0)
    before_n, end_s = loop.drive_n, len(rise) * PERIOD_S
    forces_n = follow(loop, finger, [8.0] * 800, noise_n=0.0, start_s=end_s, taper=True)
    assert loop.drive_n < before_n - 0.5 * FRICTION_N
    assert all(abs(force_n - 8.0) < 0.4 for force_n in forces_n)


def test_a_sensor_that_does_not_see_the_force_is_a_fault_not_a_reason_to_push() -> None:
    loop = new_loop()
    blind = Finger(FRICTION_N, gain=0.0, force_n=0.0)
    with pytest.raises(LimitExceeded, match="disagree"):
        follow(loop, blind, ramp(5.0, 8.0, 5.0), noise_n=0.0)
    assert loop.drive_n < 24.0


def test_the_same_sample_teaches_only_once() -> None:
    sample = ForceSample(t_s=0.1, force_n=(1.15, 1.15))
    biases_n = []
    for steps in (1, 50):
        loop = new_loop()
        for i in range(steps):
            loop.step(0.1 + i * PERIOD_S, PERIOD_S, 1.0, sample, friction_n=3.7, drive_max_n=40.0)
        biases_n.append(loop.bias_n)
    assert biases_n[0] == biases_n[1]
    assert 0.0 < biases_n[0] < 0.15


def share_learnt(rate_hz: float, noise_n: float) -> float:
    """Return how much of a step of the sensor's bias is learnt after 0.8 s, late in a hold."""
    loop = new_loop()
    for i in range(1, 561):
        now_s = i * PERIOD_S
        t_s = int(now_s * rate_hz + 1e-6) / rate_hz
        grip_n = loop.model_n + (0.1 if t_s > 2.0 else 0.0)
        sample = ForceSample(t_s=t_s, force_n=(grip_n, grip_n), lag_s=0.0, noise_n=noise_n)
        loop.step(now_s, PERIOD_S, 1.0, sample, friction_n=FRICTION_N, drive_max_n=40.0)
    return loop.bias_n / 0.1


def test_fast_samples_teach_sooner_and_noisy_ones_later() -> None:
    frames, messages = share_learnt(50.0, 0.3), share_learnt(200.0, 0.25)
    assert 0.2 < frames < 0.5
    assert messages > 1.5 * frames
    assert share_learnt(200.0, 1.0) < frames
