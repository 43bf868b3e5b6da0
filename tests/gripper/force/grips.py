"""Grips and periods of control as tests of the force law need them."""

from dataclasses import replace

from gripper.force.estimates.grip import Grip, StiffnessEstimate
from gripper.force.loop import Moment
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics
from gripper.settings import GripperSettings
from gripper.values.force_sensor import ForceSample
from tests.values import make_state

PERIOD_S = 0.005
LINKAGE = ParallelLinkage(link_m=0.06)
STATE = make_state(0.0, aperture_velocity_m_s=0.0)
STATE = replace(STATE, servos=tuple(replace(one, velocity_rad_s=0.0) for one in STATE.servos))


STIFFNESS_N_M = 1e4
"""Of pad and part at one pad."""


def make_grip(force_n: float = 1.0, touch_m: float | None = None) -> Grip:
    mechanics = Mechanics(GripperSettings(), LINKAGE)
    stiffness = StiffnessEstimate(mechanics)
    stiffness.bounds_n_m = 0.25 * STIFFNESS_N_M, STIFFNESS_N_M
    touch_m = touch_m or STATE.aperture_m + 2.0 * force_n / STIFFNESS_N_M
    grip = Grip(mechanics=mechanics, stiffness=stiffness, touch_m=touch_m, force_n=force_n)
    stiffness.apertures.add(0.0, STATE.aperture_m)
    return grip


def make_moment(
    now_s: float,
    sample: ForceSample | float | None = None,
    *,
    speed_m_s: float = 0.0,
    closed_m: float = 0.0,
    drive_n: float = 0.0,
) -> Moment:
    """Return a period; a force in N as ``sample`` is one of now, ``drive_n`` makes the currents.

    ``closed_m``: way in m by which the fingers have closed since `STATE`.
    """
    if isinstance(sample, float):
        sample = ForceSample(t_s=now_s, force_n=(sample, sample), lag_s=0.0015, noise_n=0.1)
    path = Mechanics(GripperSettings(), LINKAGE).transmissions(STATE.angles_rad)[0]
    current_a, velocity_rad_s = -drive_n / path.n_per_a, 0.5 * speed_m_s / path.radius_m
    servos = tuple(
        replace(servo, current_a=current_a, velocity_rad_s=velocity_rad_s) for servo in STATE.servos
    )
    state = replace(
        STATE,
        t_s=now_s,
        aperture_m=STATE.aperture_m - closed_m,
        aperture_velocity_m_s=speed_m_s,
        servos=servos,
    )
    return Moment(now_s=now_s, dt_s=PERIOD_S, state=state, sample=sample)
