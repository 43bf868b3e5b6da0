"""The goals of the servos: the one place that writes them, behind the limits."""

from collections.abc import Sequence

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.kinematics import Linkage
from gripper.limits import GoalGuard, ServoGoal
from gripper.registers import (
    GOAL_CURRENT,
    GOAL_POSITION,
    GOAL_VELOCITY,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    RAD_PER_PULSE,
)
from gripper.settings import GripperSettings
from gripper.state import GripperState


class WrittenGoals:
    """Writes goals that no limit is against, and remembers them.

    Parameters
    ----------
    bus, linkage, settings, clock
        Of the gripper.

    Attributes
    ----------
    guard
        The limits.
    last
        The goals written last, one for each servo; empty while none is in force.
    earlier
        Those written before them.
    """

    def __init__(
        self, bus: ServoBus, linkage: Linkage, settings: GripperSettings, clock: Clock
    ) -> None:
        self.guard = GoalGuard(settings, linkage)
        self.last: tuple[ServoGoal, ...] = ()
        self.earlier: tuple[ServoGoal, ...] = ()
        self._bus = bus
        self._settings = settings
        self._clock = clock

    def forget(self) -> None:
        """Take it that no goal is in force."""
        self.last = ()

    def write(
        self, goals: Sequence[ServoGoal], state: GripperState, *, profile_velocity_raw: int = 0
    ) -> None:
        """Write goal current and goal position of all servos at once, if no limit is against it.

        The only place that writes goals.

        Parameters
        ----------
        goals
            One for each servo.
        state
            Newest feedback: the goals are reached from there.
        profile_velocity_raw
            Profile Velocity (register 112) in raw units; 0 is no limit.
        """
        self.guard.check(goals, state, self._clock.monotonic())
        values: dict[int, list[int]] = {}
        for goal, servo, settings in zip(goals, state.servos, self._settings.servos, strict=True):
            # Relative to the present position: whole turns of the count do not matter.
            delta_rad = (goal.angle_rad - servo.angle_rad) * settings.direction
            values[servo.servo_id] = [
                settings.servo_model.current_raw(goal.current_a),
                0,
                0,
                profile_velocity_raw,
                servo.position_raw + round(delta_rad / RAD_PER_PULSE),
            ]
        self._bus.sync_write(
            values,
            GOAL_CURRENT,
            GOAL_VELOCITY,
            PROFILE_ACCELERATION,
            PROFILE_VELOCITY,
            GOAL_POSITION,
        )
        self.earlier, self.last = self.last, tuple(goals)
