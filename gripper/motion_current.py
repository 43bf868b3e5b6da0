"""The current that moves the fingers freely."""

from collections.abc import Sequence

from gripper.errors import LimitExceeded
from gripper.kinematics import Transmission
from gripper.settings import GripperSettings

_FRICTION_RESERVE = 1.2


def motion_current_a(
    settings: GripperSettings, paths: Sequence[Transmission], force_n: float
) -> float:
    """Return the current in A that moves the fingers freely and presses with ``force_n`` at most.

    Friction enters with a reserve for breaking away; LimitExceeded when the cap of the current
    does not allow it.
    """
    current_a = max(
        (force_n * p.radius_m + _FRICTION_RESERVE * p.friction_nm) / p.kt_nm_a for p in paths
    )
    if current_a > settings.current_max_a:
        raise LimitExceeded(
            f"moving the fingers takes {current_a:.3f} A, current_max_a is "
            f"{settings.current_max_a} A: raise it"
        )
    return current_a
