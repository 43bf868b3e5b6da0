"""Goals that end what the fingers do: nothing goes on, nothing pushes harder than before."""

from contextlib import suppress

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import GripperError
from gripper.feedback import Feedback
from gripper.goals import WrittenGoals
from gripper.kinematics import Linkage
from gripper.limits import ServoGoal
from gripper.motion_current import motion_current_a
from gripper.registers import BUS_WATCHDOG, GOAL_POSITION
from gripper.settings import GripperSettings

_HALT_TRIES = 3


class Standstill:
    """Writes goals that come from the last ones and the last feedback; without these nothing.

    Parameters
    ----------
    bus, linkage, settings, clock
        Of the gripper.
    feedback, goals
        Of its servos.
    """

    def __init__(
        self,
        bus: ServoBus,
        linkage: Linkage,
        settings: GripperSettings,
        clock: Clock,
        *,
        feedback: Feedback,
        goals: WrittenGoals,
    ) -> None:
        self._bus = bus
        self._linkage = linkage
        self._settings = settings
        self._clock = clock
        self._feedback = feedback
        self._goals = goals
        self._ids = [servo.servo_id for servo in settings.servos]

    def lower_currents(self) -> None:
        """Write the last goals again with ``over_force_share`` of their currents, in one step.

        The way out of too much force.
        """
        if self._feedback.last is not None and self._goals.last:
            share = self._settings.over_force_share
            goals = [
                ServoGoal(angle_rad=goal.angle_rad, current_a=share * goal.current_a)
                for goal in self._goals.last
            ]
            self._goals.write(goals, self._feedback.last)

    def calm(self) -> None:
        """Write the last goals again, with the lower current of the last two periods.

        While the force changes a square wave is on the drive: its crest must not stay.
        """
        state, last, before = self._feedback.last, self._goals.last, self._goals.earlier
        if state is not None and len(before) == len(last) > 0:
            goals = [
                ServoGoal(
                    angle_rad=goal.angle_rad, current_a=min(goal.current_a, earlier.current_a)
                )
                for goal, earlier in zip(last, before, strict=True)
            ]
            self._goals.write(goals, state)

    def halt(self) -> list[int]:
        """End a motion where the fingers are now; return the servos not known to obey.

        No servo answers to the write of all goals at once, so that they are read back.
        """
        state = self._feedback.last
        age_s = 0.0 if state is None else self._clock.monotonic() - state.t_s
        if age_s > 2.0 * self._settings.period_s and not any(map(self._bus.misses, self._ids)):
            # They have gone on since the last reading: the loop has stalled.
            with suppress(GripperError):
                self._feedback.read()
        left: list[int] = []
        for _ in range(_HALT_TRIES):
            try:
                self.stand_still()
            except GripperError:
                return list(self._ids)
            left = [servo_id for servo_id in self._ids if not self._obeys(servo_id)]
            if not left:
                break
        return left

    def _obeys(self, servo_id: int) -> bool:
        """Read whether a servo has its last goal; clear a watchdog that keeps it from taking one.

        One that has just not answered is not waited for.
        """
        if self._feedback.last is None or not self._goals.last:
            return True
        if self._bus.misses(servo_id):
            return False
        with suppress(GripperError):
            wanted_raw = self._feedback.last.servos[self._ids.index(servo_id)].position_raw
            if self._bus.read(servo_id, GOAL_POSITION) == wanted_raw:
                return True
            if self._bus.read(servo_id, BUS_WATCHDOG) < 0:
                self._bus.write(servo_id, BUS_WATCHDOG, 0)
        return False

    def stand_still(self) -> None:
        """Set the goals to the last known positions: the fingers hold where they are.

        None pushes on, and none yields by more than the servos' position control does.
        """
        state, last = self._feedback.last, self._goals.last
        if state is not None and last:
            earlier = self._goals.earlier if len(self._goals.earlier) == len(last) else last
            goals = [
                ServoGoal(
                    angle_rad=servo.angle_rad, current_a=min(goal.current_a, before.current_a)
                )
                for goal, before, servo in zip(last, earlier, state.servos, strict=True)
            ]
            self._goals.write(goals, state)

    def open_a_step(self) -> None:
        """Open by ``over_force_open_m`` from where the fingers are, once."""
        if self._feedback.last is None or not self._goals.last:
            return
        paths = self._feedback.transmissions(self._feedback.last.servos)
        step_m = self._settings.over_force_open_m
        current_a = motion_current_a(self._settings, paths, self._settings.approach_force_n)
        goals = [
            ServoGoal(
                angle_rad=servo.angle_rad
                + step_m / (len(self._ids) * self._linkage.opening_per_rad_m(servo.angle_rad)),
                current_a=current_a,
            )
            for servo in self._feedback.last.servos
        ]
        self._goals.write(goals, self._feedback.last)
