"""Stiffness of a part by its samples."""

import random
from dataclasses import replace
from statistics import median

import pytest

from gripper.force.estimates.grip import StiffnessEstimate
from gripper.force.loop import Moment
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.force_sensor import ForceSample
from tests.values import make_state


def slope_n_m(rate_hz: float, noise_n: float, seed: int = 0) -> float:
    """Return the stiffness found over 6 mm of a part of 200 N/m, from noisy samples."""
    state = make_state(aperture_velocity_m_s=-0.012)
    estimate = StiffnessEstimate(GripperSettings(servos=(ServoSettings(servo_id=1),)))
    generator = random.Random(seed)
    for i in range(100):
        now_s = 0.005 * i
        if i % round(200.0 / rate_hz) == 0:
            grip_n = 200.0 * 0.012 * now_s + generator.gauss(0.0, noise_n)
            sample = ForceSample(t_s=now_s, force_n=(grip_n, grip_n), lag_s=0.0)
        moving = replace(state, t_s=now_s, aperture_m=0.05 - 0.012 * now_s)
        estimate.push(Moment(now_s=now_s, dt_s=0.005, state=moving, sample=sample))
    return estimate.stiffness_n_m


def test_the_noise_of_fast_samples_is_no_stiffness() -> None:
    assert slope_n_m(50.0, 0.0) == pytest.approx(200.0, rel=0.05)
    found_n_m = median(slope_n_m(200.0, 0.15, seed) for seed in range(7))
    assert found_n_m == pytest.approx(200.0, rel=0.35)
