"""What a force ramp may ask for: judged from settings and linkage alone, before anything moves."""

from gripper.errors import LimitExceeded
from gripper.kinematics import Linkage, Transmission
from gripper.ramp import ForceRamp
from gripper.settings import GripperSettings


def check_ramp(ramp: ForceRamp, settings: GripperSettings, linkage: Linkage) -> None:
    """Refuse a ramp that the limits do not allow.

    Raises
    ------
    LimitExceeded
        With the number that is allowed.
    """
    largest_n = max(ramp.start_n, ramp.final_n)
    if largest_n > settings.grasp_force_limit_n:
        cap = (
            f", so that its overshoot stays below force_max_n = {settings.force_max_n} N"
            if settings.grasp_force_max_n is None
            else ""
        )
        raise LimitExceeded(
            f"the ramp asks for {largest_n} N, the limit is "
            f"{settings.grasp_force_limit_n:.2f} N{cap}"
        )
    if ramp.final_n < settings.contact_force_n:
        raise LimitExceeded(
            f"the ramp ends at {ramp.final_n} N, below contact_force_n = "
            f"{settings.contact_force_n} N: it could not hold a part"
        )
    needed_a = max(path.loading_current_a(largest_n) for path in _at_the_ends(settings, linkage))
    if needed_a > settings.current_max_a:
        raise LimitExceeded(
            f"{largest_n} N take {needed_a:.3f} A, current_max_a is {settings.current_max_a} "
            f"A: lower the force or raise the cap"
        )


def _at_the_ends(settings: GripperSettings, linkage: Linkage) -> list[Transmission]:
    """Return transmissions at both ends of the way: a force may take most current at either."""
    return [
        Transmission.at(servo.servo_model, linkage, angle_rad)
        for aperture_m in (settings.aperture_min_m, settings.aperture_open_m)
        for servo, angle_rad in zip(settings.servos, linkage.angles_rad(aperture_m), strict=True)
    ]
