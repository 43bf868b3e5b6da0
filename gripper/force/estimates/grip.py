"""State of one grip that control and supervision share."""

from dataclasses import dataclass, field

from gripper.force.estimates.history import History
from gripper.force.estimates.stiffness import StiffnessEstimate
from gripper.mechanics.impact import impact_limit
from gripper.mechanics.kinematics import Linkage
from gripper.settings import GripperSettings


@dataclass(slots=True, kw_only=True)
class Grip:
    """State of one grip, and the set-points of its control."""

    settings: GripperSettings
    linkage: Linkage
    """Of the gripper."""
    stiffness: StiffnessEstimate
    """Stiffness of the part."""
    apertures: History
    """Opening of the last periods in m."""
    setpoint_n: float
    """Set-point of the grip force in N in the last period."""
    planned_n: float
    rate_n_s: float = 0.0
    """Commanded force in N now, on the way to the set-point, and its rate in N/s."""
    force_n: float
    balance_n: float
    """Estimated grip force in N, and the drive in N that balances it without friction."""
    drive_n: float
    """Driving force of the last period in N. It opens below 0."""
    moving: int | None = None
    """Index of the finger that is measured, with the other held by position; None: neither."""
    trial_rad: float = 0.0
    """Goal of that finger in rad."""
    mass_kg: float = field(init=False)
    """Moving mass of a finger at the pad in kg."""

    def __post_init__(self) -> None:
        self.mass_kg = impact_limit(self.settings, self.linkage).mass_kg
