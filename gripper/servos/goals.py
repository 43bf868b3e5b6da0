"""Goals of the servos: their limits, and the one place that writes them.

What lowers the currents or opens the fingers passes the caps of force and temperature: it is the
way back below them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from math import exp, inf, sqrt

from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import (
    GOAL_CURRENT,
    GOAL_POSITION,
    RegisterBlock,
)
from gripper.dynamixel.drive import SIGMAS, DriveCharacteristic
from gripper.dynamixel.models import ServoModel
from gripper.errors import ForceAboveCap, LimitExceeded
from gripper.mechanics.impact import (
    SLOWEST_M_S,
    ImpactLimit,
    closing_current_max_a,
    impact_limit,
)
from gripper.mechanics.kinematics import Linkage, Transmission, transmissions
from gripper.settings import GripperSettings, OverForce, ServoSettings
from gripper.values.force_sensor import ForceSample
from gripper.values.recent import QUIET_N, RecentForce
from gripper.values.state import ServoFeedback, ServoState

_SURE_SAMPLES = 2
"""Newest samples whose mean is compared with the cap where something else excludes noise."""
_SINGLE_SAMPLE = 3.0
"""A few samples, or one, trip the cap when they are above it by as many times ``force_noise_n`` as
their noise is above that of the mean, and by no more than this."""
_ROUNDING_A = 0.005
"""What a goal current may exceed its cap by in A: two counts of 2.69 mA."""
_EQUAL = 1e-9
"""Difference, in A or rad, that counts as equal."""
_EQUAL_ANGLE_RAD = 1e-6
"""Difference of angles in rad that counts as inside of the range; a pulse is 1.5e-3 rad."""
_MOTION_RESERVE, _MOTION_PULSES = 1.5, 8.0
"""Factor and pulses by which a goal lies farther than at rest, to make up for the motion."""
_OVER_FORCE = {
    OverForce.LOWER: "the driving current is lowered in one step and the part kept",
    OverForce.OPEN: "the fingers open by one small step",
    OverForce.LIMP: "the torque is switched off, a held part possibly dropped",
}

GOAL_BLOCK = RegisterBlock.between(GOAL_CURRENT, GOAL_POSITION)
"""Registers that one write of goals sets, 102 to 119, in the order of their addresses."""

STICTION = 1.05
"""Friction at rest over friction in motion."""
_RESERVE_N = 1.5
"""What the moving mass needs beside the force asked for, in N, for the rate of a ramp. [tuned]"""
_RUNNING_SHARE = 1.25
"""Rate of the opening over ``runaway_speed_m_s`` up to which a set-point does not limit it."""
OPENING_MARGIN_RAD = 0.05
"""How far in rad beyond an opening its goal may lie, so that friction does not stop short of it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoGoal:
    """Goal of one servo in current-based position mode."""

    angle_rad: float
    """Goal position in the linkage's sense."""
    current_a: float
    """Limit of the current's magnitude."""
    setpoint_n: float | None = None
    """Grip force in N that is asked for now; None where the fingers move and press on no part."""
    profile_rad_s: float = 0.0
    """Profile Velocity (register 112) in rad/s; 0 is no limit."""


class GoalGuard:
    """Limits of the goals: of force, current, angle, speed, temperature and age of feedback."""

    def __init__(self, settings: GripperSettings, linkage: Linkage) -> None:
        self._settings = settings
        self._linkage = linkage
        self._forces = RecentForce()
        self._stood_a: dict[int, float] = {}
        self._previous_a: tuple[float, ...] = ()
        # Two apertures bound the angles: wide open, and closed onto each other with the goal as
        # far beyond as a gripping servo needs.
        self._open_rad = linkage.angles_rad(settings.aperture_open_m)
        self._lowest_rad = most_closed_rad(settings, linkage)
        self._pads = 0.5 * linkage.n_servos

    def note_force(self, sample: ForceSample) -> None:
        """Add the newest force sample; the same one may come again."""
        self._forces.push(sample)

    def bounded(self, goals: Sequence[ServoGoal], state: ServoFeedback) -> tuple[ServoGoal, ...]:
        """Return the goals with which no finger that closes presses or runs beyond its limits.

        No sample of the pads enters the current: whatever these show, a finger presses with no more
        than the set-point, friction at rest, the share that a drive may lack and what the moving
        mass needs. Without a set-point it presses below the cap, as an approach does. A finger that
        closes faster than the force left below the cap allows (`gripper.mechanics.impact`) is
        braked. While nothing presses on its pad no goal lies farther ahead than that speed needs:
        between two writes the position controller of the servo keeps to it; a profile does too.
        """
        impact = impact_limit(self._settings, self._linkage, state.angles_rad)
        newest = self.newest_force
        first_n, second_n = (0.0, 0.0) if newest is None else newest.force_n
        forces_n = (first_n, second_n) if len(goals) > 1 else (min(first_n, second_n),)
        return tuple(
            self._closing(impact, servo, path, goal, state=now, force_n=force_n)
            if goal.angle_rad < now.angle_rad
            else goal
            for servo, path, goal, now, force_n in zip(
                self._settings.servos,
                transmissions(self._settings, self._linkage, state.angles_rad),
                goals,
                state.servos,
                forces_n,
                strict=True,
            )
        )

    def _most_a(self, servo_id: int, goal: ServoGoal, path: Transmission) -> float:
        if goal.setpoint_n is None:
            stood_a = self._stood_a.get(servo_id, 0.0)
            return closing_current_max_a(self._settings, path, stood_a=stood_a)
        asked_n = exp(SIGMAS * path.drive.load_sd) * goal.setpoint_n + _RESERVE_N
        asked_a = asked_n / path.n_per_a + STICTION * path.drive.breakaway_a
        return min(asked_a, path.pressing_current_a(self._settings.force_max_n) - _EQUAL)

    def _closing(
        self,
        impact: ImpactLimit,
        servo: ServoSettings,
        path: Transmission,
        goal: ServoGoal,
        *,
        state: ServoState,
        force_n: float,
    ) -> ServoGoal:
        """Return the goal of a finger that closes, with its current and its speed bounded."""
        model = servo.servo_model
        empty = force_n < self._settings.contact_force_n
        if empty and abs(state.velocity_rad_s) <= model.slow_rad_s:
            stood_a = self._stood_a.get(state.servo_id, 0.0)
            self._stood_a[state.servo_id] = max(stood_a, -state.current_a)
        most_a = min(goal.current_a, self._most_a(state.servo_id, goal, path))
        reach_m = self._pads * self._linkage.opening_per_rad_m(state.angle_rad)
        fastest_m_s = impact.pad_speed_m_s(None if empty else force_n)
        if empty:
            # No approach is slower; until it has shown the friction, the current is the limit.
            fastest_m_s = max(fastest_m_s, 0.5 * SLOWEST_M_S)
        if goal.setpoint_n is not None:
            fastest_m_s = min(
                fastest_m_s, pressing_speed_m_s(self._settings, impact, goal.setpoint_n)
            )
        fastest_rad_s = fastest_m_s / reach_m
        over_rad_s = -state.velocity_rad_s - fastest_rad_s
        if over_rad_s > model.slow_rad_s:
            # No more momentum is taken than it has too much, or the finger would swing.
            drive_n = force_n - impact.mass_kg * over_rad_s * reach_m / self._settings.period_s
            current_a = min(abs(drive_n) / path.n_per_a, most_a)
            angle_rad = goal.angle_rad if drive_n > 0.0 else state.angle_rad
            return replace(goal, angle_rad=angle_rad, current_a=current_a)
        free = empty and goal.profile_rad_s == 0.0
        ahead_rad = lead_rad(model, most_a, fastest_rad_s) if free else inf
        angle_rad = max(goal.angle_rad, state.angle_rad - ahead_rad)
        return replace(goal, angle_rad=angle_rad, current_a=most_a)

    @property
    def newest_force(self) -> ForceSample | None:
        """The newest force sample; None before the first one."""
        return self._forces.newest if self._forces else None

    def force_is_too_high(self) -> bool:
        """Return whether the measured force is above the cap by more than noise."""
        return self._excess_n() > 0.0

    def check_force(self, *, noise_excluded: bool = False) -> None:
        """Raise ForceAboveCap while the measured force is above the cap.

        With ``noise_excluded`` something else has shown that the force is none: then nothing is
        allowed for it.
        """
        settings = self._settings
        if noise_excluded:
            newest = list(islice(self._forces, _SURE_SAMPLES))
            too_high = sum(max(one.force_n) for one in newest) > settings.force_max_n * len(newest)
        else:
            too_high = self.force_is_too_high()
        if too_high:
            raise ForceAboveCap(
                f"the grip force is {max(self._forces.newest.force_n):.2f} N, force_max_n is "
                f"{settings.force_max_n} N (and {settings.force_noise_n} N for noise): "
                f"{_OVER_FORCE[settings.over_force]}; clear the fault, then release the part"
            )

    def check(self, goals: Sequence[ServoGoal], state: ServoFeedback, now_s: float) -> None:
        """Check goals that are to be written now; those that pass are the next ones' measure.

        Raises LimitExceeded when a limit is against the goals; it is named.
        """
        settings, age_s = self._settings, now_s - state.t_s
        if age_s > settings.bus_loss_s:
            raise LimitExceeded(
                f"the servos' feedback is {age_s:.3f} s old, at most {settings.bus_loss_s} s are "
                f"allowed: check the servo bus"
            )
        lowering = len(goals) == len(self._previous_a) and all(
            goal.current_a <= before_a + _EQUAL
            for goal, before_a in zip(goals, self._previous_a, strict=True)
        )
        for index, (goal, servo) in enumerate(zip(goals, state.servos, strict=True)):
            self._check_goal(index, goal, servo.angle_rad)
        opening = all(
            goal.angle_rad >= servo.angle_rad - _EQUAL
            for goal, servo in zip(goals, state.servos, strict=True)
        )
        if not lowering and not opening:
            paths = transmissions(settings, self._linkage, state.angles_rad)
            for servo_settings, path, goal in zip(settings.servos, paths, goals, strict=True):
                self._check_current_force(servo_settings.servo_id, path, goal)
            if state.temperature_c > settings.temperature_max_c:
                raise LimitExceeded(
                    f"a servo has {state.temperature_c:.0f} C, temperature_max_c is "
                    f"{settings.temperature_max_c:g}: let it cool down"
                )
            newest = self.newest_force
            if newest is not None and now_s - newest.t_s <= settings.force_stale_s:
                self.check_force()
        self._previous_a = tuple(goal.current_a for goal in goals)

    def _excess_n(self) -> float:
        """Return by how much the force is above what noise may make of the cap, in N.

        The more samples, the less that is: what is far too much shows with the first one.
        """
        settings = self._settings
        first_n = second_n = variance_n2 = 0.0
        most_n = -inf
        for n, sample in enumerate(self._forces, 1):
            first_n += sample.force_n[0]
            second_n += sample.force_n[1]
            variance_n2 += sample.noise_n**2
            few = n < len(self._forces)
            times = min(_SINGLE_SAMPLE, sqrt(variance_n2) / n / QUIET_N) if few else 1.0
            most_n = max(most_n, max(first_n, second_n) / n - times * settings.force_noise_n)
        return most_n - settings.force_max_n

    def _check_goal(self, index: int, goal: ServoGoal, angle_rad: float) -> None:
        settings = self._settings
        servo = settings.servos[index]
        if not 0.0 <= goal.current_a <= settings.current_max_a + _ROUNDING_A:
            raise LimitExceeded(
                f"goal current {goal.current_a:.3f} A of servo {servo.servo_id} is not from 0 to "
                f"current_max_a = {settings.current_max_a} A"
            )
        low_rad = self._lowest_rad[index]
        drive = settings.drives.of(servo.servo_id, servo.drive)
        margin_rad = max(OPENING_MARGIN_RAD, 1.1 * overrun_rad(servo.servo_model, drive))
        high_rad = self._open_rad[index] + margin_rad
        # Fingers that stand outside (moved by hand) may be brought back in.
        lowest_rad = min(low_rad, angle_rad) - _EQUAL_ANGLE_RAD
        if not lowest_rad <= goal.angle_rad <= max(high_rad, angle_rad) + _EQUAL_ANGLE_RAD:
            raise LimitExceeded(
                f"goal angle {goal.angle_rad:.4f} rad of servo {servo.servo_id} is not from "
                f"{low_rad:.4f} to {high_rad:.4f} rad (closed to aperture_open_m)"
            )

    def _check_current_force(self, servo_id: int, path: Transmission, goal: ServoGoal) -> None:
        settings = self._settings
        least_n = path.force_band_n(goal.current_a)[0]
        if least_n > settings.force_max_n:
            raise LimitExceeded(
                f"goal current {goal.current_a:.3f} A of servo {servo_id} makes at least "
                f"{least_n:.1f} N, force_max_n is {settings.force_max_n} N"
            )


def pressing_speed_m_s(settings: GripperSettings, impact: ImpactLimit, setpoint_n: float) -> float:
    """Return the largest speed of a pad in m/s at a set-point in N, whatever the pads show.

    What its drive may press with leaves the rest below the cap for momentum. Fingers that run as
    they do without a part are not slowed down so far that nothing shows it.
    """
    runs_m_s = 0.5 * _RUNNING_SHARE * settings.runaway_speed_m_s
    return max(impact.pad_speed_m_s(impact.load_share * setpoint_n + _RESERVE_N), runs_m_s)


def most_closed_rad(settings: GripperSettings, linkage: Linkage) -> tuple[float, ...]:
    """Return the most closed goal of each servo in rad: pads that meet, at the largest current."""
    return tuple(
        angle_rad - closing_margin_rad(servo.servo_model, settings.current_max_a)
        for angle_rad, servo in zip(linkage.angles_rad(0.0), settings.servos, strict=True)
    )


def closing_margin_rad(model: ServoModel, current_a: float) -> float:
    """Return how far in rad beyond the contact a goal must lie to reach a limit of the current.

    The position controller asks for gain / 128 counts of PWM for each pulse of error (e-Manual,
    Position PID Gain); 885 counts are the whole supply, at rest the stall current. Half as much
    again and a few pulses make up for the motion.
    """
    _, _, position_p_gain = model.position_gains
    current_share = current_a / model.stall_current_a
    pwm = _MOTION_RESERVE * current_share * model.whole_pwm_raw
    pulses = pwm * model.error_per_pwm / position_p_gain + _MOTION_PULSES
    return pulses * model.rad_per_pulse


def lead_rad(model: ServoModel, current_a: float, speed_rad_s: float) -> float:
    """Return how far in rad ahead a goal must lie, at the most, for a current and a speed."""
    return closing_margin_rad(model, current_a) + running_lead_rad(model, 0.0, speed_rad_s)


def running_lead_rad(model: ServoModel, current_a: float, speed_rad_s: float) -> float:
    """Return how far in rad ahead the goal of a servo is that runs steadily with a current.

    The position controller is proportional, see `closing_margin_rad`; what the speed takes is the
    voltage that the motor makes itself, as a share of the supply that of its no-load speed.
    """
    _, _, position_p_gain = model.position_gains
    share = current_a / model.stall_current_a + speed_rad_s / model.no_load_rad_s
    pulses = model.whole_pwm_raw * share * model.error_per_pwm / position_p_gain
    return pulses * model.rad_per_pulse


def overrun_rad(model: ServoModel, drive: DriveCharacteristic) -> float:
    """Return how far in rad beyond an opening its goal runs, so that friction stops no finger."""
    breaking_a = STICTION**2 * drive.breakaway_a
    return max(0.6 * OPENING_MARGIN_RAD, running_lead_rad(model, breaking_a, 0.0))


class GoalWriter:
    """Writer of the goals, behind their limits; keeps the goals that are in force."""

    def __init__(
        self, bus: ServoBus, settings: GripperSettings, clock: Clock, guard: GoalGuard
    ) -> None:
        self.last: tuple[ServoGoal, ...] = ()
        """The goals written last, one for each servo; empty while none is in force."""
        self.earlier: tuple[ServoGoal, ...] = ()
        """Those written before them."""
        self._guard = guard
        self._bus = bus
        self._settings = settings
        self._clock = clock

    def forget(self) -> None:
        """Discard the last goals: none is in force any more."""
        self.last = ()

    def write(self, goals: Sequence[ServoGoal], state: ServoFeedback) -> None:
        """Write goal current and goal position of all servos at once, if no limit is against it.

        The only place that writes goals.

        Parameters
        ----------
        state
            Newest feedback: the goals are reached from there.
        """
        goals = self._guard.bounded(goals, state)
        self._guard.check(goals, state, self._clock.monotonic())
        values: dict[int, list[int]] = {}
        for goal, servo, settings in zip(goals, state.servos, self._settings.servos, strict=True):
            # Relative to the present position: whole turns of the count do not matter.
            model = settings.servo_model
            delta_rad = (goal.angle_rad - servo.angle_rad) * settings.direction
            goal_current = model.current_raw(goal.current_a)
            profile_acceleration = 0
            least_raw, most_raw = model.goal_range_raw
            if not least_raw <= servo.position_raw <= most_raw:
                raise LimitExceeded(
                    f"servo {servo.servo_id} stands at {servo.position_raw}, a {model.name} takes "
                    f"goals from {least_raw} to {most_raw} only: switch its supply off and push "
                    "its finger back by hand"
                )
            goal_position = servo.position_raw + round(delta_rad / model.rad_per_pulse)
            # A goal beyond would be refused, and nothing answers to this write.
            goal_position = min(max(goal_position, least_raw), most_raw)
            values[servo.servo_id] = [
                goal_current,
                model.goal_velocity_raw,
                profile_acceleration,
                round(goal.profile_rad_s / model.velocity_unit_rad_s),
                goal_position,
            ]
        self._bus.sync_write(values, GOAL_BLOCK)
        self.earlier, self.last = self.last, tuple(goals)
