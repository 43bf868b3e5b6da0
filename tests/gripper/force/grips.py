"""Grips and periods of control as tests of one mode need them: fingers that stand, no part."""

from dataclasses import replace
from typing import Any

from gripper.force.control.period import Period
from gripper.force.estimates.force_estimate import ForceEstimate
from gripper.force.estimates.grip import Grip
from gripper.force.estimates.history import History
from gripper.force.estimates.stiffness import StiffnessEstimate
from gripper.force.loop import Moment
from gripper.mechanics.kinematics import ParallelLinkage, transmissions
from gripper.settings import ForceLoopSettings, GripperSettings
from gripper.values.force_sensor import ForceSample
from tests.values import make_state

PERIOD_S = 0.005
FRICTION_N = 3.7
LINKAGE = ParallelLinkage(link_m=0.06)
STATE = make_state(0.0, aperture_velocity_m_s=0.0)
STATE = replace(STATE, servos=tuple(replace(one, velocity_rad_s=0.0) for one in STATE.servos))


def make_grip(force_n: float = 1.0, **tuning: float) -> Grip:
    settings = GripperSettings(force_loop=ForceLoopSettings(end_time_s=0.0, **tuning))
    apertures = History()
    apertures.add(0.0, STATE.aperture_m)
    return Grip(
        settings=settings,
        linkage=LINKAGE,
        estimate=ForceEstimate(settings.force_loop, force_n=force_n, now_s=0.0),
        stiffness=StiffnessEstimate(settings),
        apertures=apertures,
        setpoint_n=force_n,
        asked_n=force_n,
        drive_n=force_n,
        quiet_n=force_n,
    )


def make_period(
    now_s: float,
    setpoint_n: float,
    sample: ForceSample | float | None = None,
    *,
    dt_s: float = PERIOD_S,
    speed_m_s: float = 0.0,
    drive_n: float = 0.0,
    **changes: Any,
) -> Period:
    """Return a period; a force in N as ``sample`` is one of now, ``drive_n`` makes the currents."""
    if isinstance(sample, float):
        sample = ForceSample(t_s=now_s, force_n=(sample, sample), lag_s=0.0015, noise_n=0.1)
    paths = transmissions(GripperSettings(), LINKAGE, STATE.angles_rad)
    current_a = -drive_n / paths[0].n_per_a
    servos = tuple(replace(one, current_a=current_a) for one in STATE.servos)
    state = replace(STATE, t_s=now_s, aperture_velocity_m_s=speed_m_s, servos=servos)
    usual = {
        "usable": sample is not None,
        "quick": dt_s <= 2 * PERIOD_S,
        "rises_n": 0.0,
        "arrival_n": None,
        "taper": False,
        "friction_n": FRICTION_N,
        "doubt_n": 1.0,
        "drive_max_n": 40.0,
        "inertia_n": 0.0,
        "may_open": True,
        "paths": paths,
    }
    return Period(
        moment=Moment(now_s=now_s, dt_s=dt_s, state=state, sample=sample),
        setpoint_n=setpoint_n,
        **(usual | changes),
    )
