"""State of one grip that control and supervision share."""

from dataclasses import dataclass, field

from gripper.force.estimates.force_estimate import ForceEstimate
from gripper.force.estimates.history import History
from gripper.force.estimates.stiffness import StiffnessEstimate
from gripper.mechanics.impact import impact_limit
from gripper.mechanics.kinematics import Linkage, transmissions
from gripper.settings import GripperSettings

_LEVER_M = 0.06
"""Lever in m between servo and fingertip for which damping, inertia and doubt by motion are given.
The motor's mass at the fingertip goes with the inverse of its square. [chosen]"""
_DAMPED_SHARE = 0.25
"""Largest share of its momentum that damping may remove from a finger in one period. A larger share
would make a light finger swing at a low sample rate. [tuned]"""


@dataclass(slots=True, kw_only=True)
class Grip:
    """State of one grip, and the set-points of its control."""

    settings: GripperSettings
    linkage: Linkage
    """Of the gripper."""
    estimate: ForceEstimate
    stiffness: StiffnessEstimate
    """Grip force, and stiffness of the part."""
    apertures: History
    """Opening of the last periods in m."""
    setpoint_n: float
    """Set-point of the grip force in N in the last period."""
    asked_n: float
    rate_n_s: float = 0.0
    """Commanded force in N now, on the way to the set-point, and its rate in N/s."""
    drive_n: float
    quiet_n: float
    """Driving force of the last period in N, and without the square wave on it. It opens
    below 0."""
    moving: int | None = None
    """Index of the finger that is measured, with the other held by position; None: neither."""
    trial_rad: float = 0.0
    """Goal of that finger in rad."""
    mass_kg: float = field(init=False)
    """Moving mass of a finger at the pad."""
    motor_share: float = field(init=False)
    """Motor's mass at the fingertip over that with a lever of 60 mm."""

    def __post_init__(self) -> None:
        closed = transmissions(self.settings, self.linkage, self.linkage.angles_rad(0.0))
        self.motor_share = sum((_LEVER_M / path.radius_m) ** 2 for path in closed) / len(closed)
        self.mass_kg = impact_limit(self.settings, self.linkage).mass_kg

    def swing_n_s_m(self, share_n_s_m: float) -> float:
        """Convert a drive in N for each m/s from a lever of 60 mm to this gripper."""
        stable_n_s_m = _DAMPED_SHARE * self.mass_kg / self.settings.period_s
        return min(self.motor_share * share_n_s_m, stable_n_s_m)
