"""The servos of one gripper as a group: torque and bus watchdog."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import GripperError, ServoFault
from gripper.feedback import Feedback
from gripper.goals import WrittenGoals
from gripper.health import ServoHealth
from gripper.kinematics import Linkage
from gripper.limits import ServoGoal
from gripper.registers import (
    BUS_WATCHDOG,
    GOAL_POSITION,
    GOAL_PWM,
    OPERATING_MODE,
    PWM_LIMIT,
    TORQUE_ENABLE,
    OperatingMode,
)
from gripper.settings import GripperSettings
from gripper.standstill import Standstill
from gripper.state import GripperState


class ServoGroup:
    """Torque and bus watchdog of all servos, and what else there is to do with them.

    Parameters
    ----------
    bus, linkage, settings, clock
        Of the gripper.

    Attributes
    ----------
    goals
        The goals, and the one way to write them.
    health
        What the servos are set to.
    feedback
        What the servos report.
    standstill
        Goals that end what the fingers do.
    """

    def __init__(
        self, bus: ServoBus, linkage: Linkage, settings: GripperSettings, clock: Clock
    ) -> None:
        self.goals = WrittenGoals(bus, linkage, settings, clock)
        self.health = ServoHealth(bus, settings)
        self.feedback = Feedback(
            bus, linkage, settings, clock, goals=self.goals, health=self.health
        )
        self.standstill = Standstill(
            bus, linkage, settings, clock, feedback=self.feedback, goals=self.goals
        )
        self._bus = bus
        self._settings = settings
        self._ids = [servo.servo_id for servo in settings.servos]

    def in_loop(self) -> AbstractContextManager[None]:
        """Let no transaction within the block wait longer than the loop may; see `ServoBus`."""
        return self._bus.in_loop()

    def silent_and_living(self) -> tuple[list[int], list[int]]:
        """Return the IDs of the servos that did not answer last, and of those that did."""
        silent = [servo_id for servo_id in self._ids if self._bus.misses(servo_id)]
        return silent, [servo_id for servo_id in self._ids if servo_id not in silent]

    def switch_on(self, current_a: float) -> GripperState:
        """Set the goals to the present positions, switch the torque on, arm the watchdog."""
        self.disarm_watchdog()
        state = self._freeze_at_present(current_a)
        for servo_id in self._ids:
            self._bus.write(servo_id, TORQUE_ENABLE, 1)
        self.arm_watchdog()
        return state

    def restart_watchdog(self, current_a: float) -> GripperState:
        """Clear a tripped watchdog, set the goals to the present positions and arm it again."""
        self.disarm_watchdog()
        state = self._freeze_at_present(current_a)
        self.arm_watchdog()
        return state

    def switch_off(self) -> None:
        """Disarm the watchdog and switch the torque off."""
        self.disarm_watchdog()
        for servo_id in self._ids:
            self._bus.write(servo_id, TORQUE_ENABLE, 0)
        self.goals.forget()

    def go_limp(self) -> None:
        """Switch the torque of every servo off that answers: position or force are unknown."""
        self.goals.forget()
        for servo_id in self._ids:
            with suppress(GripperError):
                self._bus.write(servo_id, TORQUE_ENABLE, 0)
        self.disarm_each()

    def forget(self) -> None:
        """Take nothing for granted any more that was written or read before."""
        self.goals.forget()
        self.feedback.forget()

    def arm_watchdog(self) -> None:
        """Arm the bus watchdog of each servo (register 98)."""
        for servo_id in self._ids:
            self._bus.write(servo_id, BUS_WATCHDOG, self._settings.watchdog_raw)

    def disarm_watchdog(self) -> None:
        """Disarm, or clear after a trip, the bus watchdog of each servo."""
        for servo_id in self._ids:
            self._bus.write(servo_id, BUS_WATCHDOG, 0)

    def disarm_each(self, *, but: Sequence[int] = ()) -> None:
        """Disarm the bus watchdog of every servo that answers, with exceptions."""
        for servo_id in self._ids:
            if servo_id not in but:
                with suppress(GripperError):
                    self._bus.write(servo_id, BUS_WATCHDOG, 0)

    def _freeze_at_present(self, current_a: float) -> GripperState:
        for servo_id in self._ids:
            if self._bus.read(servo_id, OPERATING_MODE) != OperatingMode.CURRENT_BASED_POSITION:
                raise ServoFault(
                    servo_id, 0, "its operating mode is no longer 5 (current-based position)"
                )
            # The goals of the other modes limit this one too.
            self._bus.write(servo_id, GOAL_PWM, self._bus.read(servo_id, PWM_LIMIT))
        state = self.feedback.read_patiently()
        goals = [ServoGoal(angle_rad=s.angle_rad, current_a=current_a) for s in state.servos]
        self.goals.write(goals, state)
        for servo in state.servos:
            found = self._bus.read(servo.servo_id, GOAL_POSITION)
            if found != servo.position_raw:
                raise ServoFault(
                    servo.servo_id,
                    0,
                    f"it did not take its goal position: wrote {servo.position_raw}, read {found}",
                )
        return state
