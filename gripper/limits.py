"""Limits beside the write to the servos: every goal passes here, or it is not written.

What lowers the currents or opens the fingers passes the caps of force and temperature: it is the
way back below them.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from gripper.errors import ForceAboveCap, LimitExceeded
from gripper.force import ForceSample
from gripper.kinematics import Linkage, Transmission
from gripper.registers import RAD_PER_PULSE
from gripper.settings import GripperSettings, OverForce
from gripper.state import GripperState

_FORCE_SAMPLES = 3
_ROUNDING_A = 0.005
_SINGLE_SAMPLE = 3.0
_OVER_FORCE = {
    OverForce.LOWER: "the driving current is lowered in one step and the part kept",
    OverForce.OPEN: "the fingers open by one small step",
    OverForce.LIMP: "the torque is switched off, a held part possibly dropped",
}

OPENING_MARGIN_RAD = 0.05
"""How far beyond an opening its goal may lie, so that friction does not stop short of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoGoal:
    """Goal of one servo in current-based position mode.

    Attributes
    ----------
    angle_rad
        Goal position in the linkage's sense.
    current_a
        Limit of the current's magnitude.
    """

    angle_rad: float
    current_a: float


class GoalGuard:
    """Refuses goals beyond a limit.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings, linkage: Linkage) -> None:
        self._settings = settings
        self._linkage = linkage
        self._forces: deque[ForceSample] = deque(maxlen=_FORCE_SAMPLES)
        self._previous_a: tuple[float, ...] = ()
        # Two apertures bound the angles: wide open, and closed onto each other with the goal as
        # far beyond as a gripping servo needs.
        self._highest_rad = tuple(
            angle + OPENING_MARGIN_RAD for angle in linkage.angles_rad(settings.aperture_open_m)
        )
        self._lowest_rad = tuple(
            angle - closing_margin_rad(servo.servo_model.position_gains[2], share)
            for angle, servo in zip(linkage.angles_rad(0.0), settings.servos, strict=True)
            for share in (settings.current_max_a / servo.servo_model.stall_current_a,)
        )

    def note_force(self, sample: ForceSample) -> None:
        """Take the newest force sample; the same one may come again."""
        if not self._forces or sample.t_s > self._forces[-1].t_s:
            self._forces.append(sample)

    def force_n(self) -> float:
        """Return the mean of the last samples of the more heavily loaded finger in N."""
        if not self._forces:
            return 0.0
        return max(
            sum(sample.force_n[finger] for sample in self._forces) / len(self._forces)
            for finger in (0, 1)
        )

    def force_is_too_high(self) -> bool:
        """Say whether the measured force is above the cap by more than noise.

        A single sample counts when it is above it by three times that.
        """
        settings = self._settings
        newest_n = max(self._forces[-1].force_n) if self._forces else 0.0
        return (
            self.force_n() > settings.force_max_n + settings.force_noise_n
            or newest_n > settings.force_max_n + _SINGLE_SAMPLE * settings.force_noise_n
        )

    def _highest_n(self) -> float:
        return max(self.force_n(), max(self._forces[-1].force_n) if self._forces else 0.0)

    def check_force(self) -> None:
        """Raise LimitExceeded while the measured force is above the cap."""
        settings = self._settings
        if self.force_is_too_high():
            raise ForceAboveCap(
                f"the grip force is {self._highest_n():.2f} N, force_max_n is "
                f"{settings.force_max_n} N (and {settings.force_noise_n} N for noise): "
                f"{_OVER_FORCE[settings.over_force]}; clear the fault, then release the part"
            )

    def check(self, goals: Sequence[ServoGoal], state: GripperState, now_s: float) -> None:
        """Return when the goals may be written.

        Raises
        ------
        LimitExceeded
            With the limit that stands against it.
        """
        self._check_age(state, now_s)
        lowering = len(goals) == len(self._previous_a) and all(
            goal.current_a <= before_a + 1e-9
            for goal, before_a in zip(goals, self._previous_a, strict=True)
        )
        for index, (goal, servo) in enumerate(zip(goals, state.servos, strict=True)):
            self._check_goal(index, goal, servo.angle_rad)
        opening = all(
            goal.angle_rad >= servo.angle_rad - 1e-9
            for goal, servo in zip(goals, state.servos, strict=True)
        )
        if not lowering and not opening:
            for index, (goal, servo) in enumerate(zip(goals, state.servos, strict=True)):
                self._check_current_force(index, goal, servo.angle_rad)
            self._check_temperature(state)
            self.check_force()
        self._previous_a = tuple(goal.current_a for goal in goals)

    def _check_age(self, state: GripperState, now_s: float) -> None:
        settings = self._settings
        if now_s - state.t_s > settings.bus_loss_s:
            raise LimitExceeded(
                f"the servos' feedback is {now_s - state.t_s:.3f} s old, at most "
                f"{settings.bus_loss_s} s are allowed: check the servo bus"
            )

    def _check_temperature(self, state: GripperState) -> None:
        settings = self._settings
        if state.temperature_c > settings.temperature_max_c:
            raise LimitExceeded(
                f"a servo has {state.temperature_c:.0f} C, temperature_max_c is "
                f"{settings.temperature_max_c:g}: let it cool down"
            )

    def _check_goal(self, index: int, goal: ServoGoal, angle_rad: float) -> None:
        settings = self._settings
        servo = settings.servos[index]
        if not 0.0 <= goal.current_a <= settings.current_max_a + _ROUNDING_A:
            raise LimitExceeded(
                f"goal current {goal.current_a:.3f} A of servo {servo.servo_id} is not from 0 to "
                f"current_max_a = {settings.current_max_a} A"
            )
        low_rad, high_rad = self._lowest_rad[index], self._highest_rad[index]
        # Fingers that stand outside (moved by hand) may be brought back in.
        if not min(low_rad, angle_rad) - 1e-6 <= goal.angle_rad <= max(high_rad, angle_rad) + 1e-6:
            raise LimitExceeded(
                f"goal angle {goal.angle_rad:.4f} rad of servo {servo.servo_id} is not from "
                f"{low_rad:.4f} to {high_rad:.4f} rad (closed to aperture_open_m)"
            )

    def _check_current_force(self, index: int, goal: ServoGoal, angle_rad: float) -> None:
        settings = self._settings
        servo = settings.servos[index]
        path = Transmission.at(servo.servo_model, self._linkage, angle_rad)
        least_n = path.force_band_n(goal.current_a)[0]
        if least_n > settings.force_max_n:
            raise LimitExceeded(
                f"goal current {goal.current_a:.3f} A of servo {servo.servo_id} makes at least "
                f"{least_n:.1f} N, force_max_n is {settings.force_max_n} N"
            )


def closing_margin_rad(position_p_gain: int, current_share: float) -> float:
    """Return how far beyond the contact a goal must lie so that the current limit is reached.

    The position controller asks for gain / 128 counts of PWM for each pulse of error (e-Manual,
    Position PID Gain); 885 counts are the whole supply, at standstill the stall current. Half as
    much again and a few pulses make up for the motion.

    Parameters
    ----------
    position_p_gain
        Position P Gain (register 84), raw.
    current_share
        Wanted current over stall current.
    """
    pulses = 1.5 * current_share * 885.0 * 128.0 / position_p_gain + 8.0
    return pulses * RAD_PER_PULSE
