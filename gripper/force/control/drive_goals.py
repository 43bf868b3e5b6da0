"""Goals of the servos that make a driving force, and how far they may close and open."""

from collections.abc import Sequence
from math import inf

from gripper.mechanics.kinematics import Linkage, Transmission
from gripper.servos.goals import ServoGoal, closing_margin_rad, most_closed_rad
from gripper.settings import GripperSettings
from gripper.values.state import GripperState

GIVE_RAD = 0.03
"""How far in rad a goal may open beyond the contact: pads and part are deeper there by no more.
[assumed]"""


class DriveGoals:
    """Goals of the servos of one grip.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    contact
        Feedback at the contact; the fingers are not driven open beyond it by more than a pad's
        thickness.
    touch_m
        Opening in m at which both pads were first loaded: the fingers are not driven open beyond
        it, however much force the pads report.
    """

    def __init__(
        self, settings: GripperSettings, linkage: Linkage, contact: GripperState, touch_m: float
    ) -> None:
        self._settings = settings
        self._contact_rad = self._deepest_rad = contact.angles_rad
        self._least_rad = most_closed_rad(settings, linkage)
        self._touch_m = touch_m
        self._stop_rad: tuple[float, ...] | None = None

    @property
    def may_open(self) -> bool:
        """Whether the fingers may open farther."""
        return self._stop_rad is None

    def goals(
        self,
        drive_n: float,
        state: GripperState,
        paths: Sequence[Transmission],
        *,
        setpoint_n: float,
        friction_share: float,
    ) -> tuple[ServoGoal, ...]:
        """Return the goals that make a driving force in N.

        Parameters
        ----------
        drive_n
            Below 0 it pushes the fingers open.
        state, paths
            Feedback, and the transmission of each servo there.
        setpoint_n, friction_share
            As `ServoGoal`.
        """
        goals = []
        self._deepest_rad = tuple(map(min, self._deepest_rad, state.angles_rad))
        if state.aperture_m < self._touch_m:
            self._stop_rad = None
        elif self._stop_rad is None:
            self._stop_rad = state.angles_rad
        stop_rad = self._stop_rad or (inf,) * len(paths)
        for servo, path, settings, contact_rad, deepest_rad, widest_rad, least_rad in zip(
            state.servos,
            paths,
            self._settings.servos,
            self._contact_rad,
            self._deepest_rad,
            stop_rad,
            self._least_rad,
            strict=True,
        ):
            current_a = min(
                abs(drive_n) * path.radius_m / path.kt_nm_a, self._settings.current_max_a
            )
            margin_rad = closing_margin_rad(settings.servo_model, current_a)
            # In mode 5 the goal current is a magnitude: the side of the goal position is its sign.
            # A position that drifts open must not take a closing goal to the open side with it.
            if drive_n >= 0.0:
                angle_rad = max(deepest_rad - margin_rad, min(least_rad, servo.angle_rad))
            else:
                angle_rad = min(servo.angle_rad + margin_rad, contact_rad + GIVE_RAD, widest_rad)
            goals.append(
                ServoGoal(
                    angle_rad=angle_rad,
                    current_a=current_a,
                    setpoint_n=setpoint_n,
                    friction_share=friction_share,
                )
            )
        return tuple(goals)
