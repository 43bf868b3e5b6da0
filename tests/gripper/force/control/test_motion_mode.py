"""The mode of planned motions alone, on a finger with mass, friction and a spring."""

from dataclasses import replace

import pytest

from gripper.force.control.motion_mode import MotionMode
from gripper.force.control.period import Mode
from gripper.mechanics.kinematics import Transmission, transmissions
from gripper.settings import GripperSettings
from tests.gripper.force.grips import LINKAGE, PERIOD_S, STATE, make_grip, make_period

STIFFNESS_N_M = 1e4
"""Of pad and part at one pad."""
PATHS = transmissions(GripperSettings(), LINKAGE, STATE.angles_rad)
"""Gearings with Coulomb friction alone."""


class Finger:
    """A mass that friction brakes and a spring pushes back, in steps of 0.1 ms."""

    def __init__(self, path: Transmission, mass_kg: float, force_n: float) -> None:
        self.path = path
        self.mass_kg = mass_kg
        self.force_n = force_n
        self.speed_m_s = 0.0

    def drive(self, drive_n: float) -> None:
        step_s = 1e-4
        for _ in range(round(PERIOD_S / step_s)):
            push_n = drive_n - self.force_n
            opening_n = self.force_n - self.path.yielding_n(self.force_n)
            if self.speed_m_s == 0.0 and -opening_n <= push_n <= self.path.friction_n:
                continue
            closes = (self.speed_m_s or push_n) > 0.0
            brake_n = self.path.friction_n if closes else -opening_n
            before_m_s = self.speed_m_s
            self.speed_m_s += (push_n - brake_n) / self.mass_kg * step_s
            if before_m_s * self.speed_m_s < 0.0:
                self.speed_m_s = 0.0
            self.force_n += STIFFNESS_N_M * self.speed_m_s * step_s


def moved(
    setpoints_n: list[float],
    force_n: float,
    *,
    begins_n: float,
    paths: tuple[Transmission, ...] = PATHS,
) -> tuple[float, float]:
    """Return the largest force and that at the end of a motion along set-points, in N."""
    grip = make_grip(force_n)
    grip.drive_n = grip.quiet_n = force_n
    mode = MotionMode(grip, 0.0, STIFFNESS_N_M)
    finger = Finger(paths[0], grip.mass_kg, force_n)
    peak_n, before_n = 0.0, begins_n
    for i, setpoint_n in enumerate(setpoints_n):
        period = make_period(
            i * PERIOD_S,
            setpoint_n,
            finger.force_n,
            rises_n=setpoint_n - before_n,
            arrival_n=setpoints_n[-1],
            speed_m_s=-2.0 * finger.speed_m_s,
            drive_n=grip.drive_n,
            paths=paths,
            friction_n=paths[0].friction_n,
        )
        if i == 0:
            mode.enter(period, Mode())
        grip.drive_n = mode.step(period)
        before_n = setpoint_n
        if mode.over:
            mode.exit(period)
            assert (mode.ended_s, grip.asked_n) == (i * PERIOD_S, setpoint_n)
            break
        finger.drive(grip.drive_n)
        peak_n = max(peak_n, finger.force_n)
    assert mode.over
    assert finger.speed_m_s == pytest.approx(0.0, abs=1e-3)
    return peak_n, finger.force_n


@pytest.mark.parametrize("rate_n_s", [10.0, 20.0, 40.0])
def test_a_fast_rise_ends_just_below_its_set_point(rate_n_s: float) -> None:
    steps = round(5.0 / rate_n_s / PERIOD_S)
    setpoints_n = [1.0 + 5.0 * (i + 1) / steps for i in range(steps)] + [6.0] * 100
    peak_n, end_n = moved(setpoints_n, 1.0, begins_n=1.0)
    assert peak_n < 6.15
    assert end_n == pytest.approx(5.9, abs=0.2)


@pytest.mark.parametrize("rate_n_s", [10.0, 20.0])
def test_a_gearing_that_holds_the_load_brakes_a_fast_rise(rate_n_s: float) -> None:
    path = PATHS[0]
    usual = path.drive
    lossy = replace(
        usual,
        breakaway_a=0.08 * usual.breakaway_a,
        falling_a_nm=usual.rising_a_nm / 3.5,
        yielding_share=0.6,
    )
    steps = round(5.0 / rate_n_s / PERIOD_S)
    setpoints_n = [1.0 + 5.0 * (i + 1) / steps for i in range(steps)] + [6.0] * 100
    paths = (path._replace(drive=lossy),) * 2
    peak_n, end_n = moved(setpoints_n, 1.0, begins_n=1.0, paths=paths)
    assert peak_n < 6.15
    assert end_n == pytest.approx(5.9, abs=0.2)


@pytest.mark.parametrize("setpoint_n", [3.6, 4.4])
def test_an_error_of_a_hold_is_made_up_for_either_way(setpoint_n: float) -> None:
    _, end_n = moved([setpoint_n] * 200, 4.0, begins_n=setpoint_n)
    assert end_n == pytest.approx(setpoint_n, abs=0.1)


def test_what_a_motion_has_learnt_is_where_the_next_one_begins() -> None:
    mode = MotionMode(make_grip(2.0), 0.0, STIFFNESS_N_M)
    rises = make_period(0.0, 2.1, 2.0, rises_n=0.1)
    mode.enter(rises, Mode())
    mode.observer.lacking_n = 0.7
    mode.exit(rises)
    assert mode.ended_s == 0.0  # it has not arrived: no pause follows
    mode.enter(make_period(0.1, 2.3, 2.1, rises_n=0.2), Mode())
    assert mode.observer.lacking_n == 0.7
    assert mode.observer.stiffness_n_m == pytest.approx(STIFFNESS_N_M)
