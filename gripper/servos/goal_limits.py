"""Goals of the servos: their limits, and the one place that writes them.

Goals that lower the currents or open the fingers pass the caps of force and temperature: they lead
back below them.
"""

from collections.abc import Sequence
from itertools import islice
from math import copysign, exp, inf, sqrt
from typing import NamedTuple

from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import GOAL_CURRENT, GOAL_POSITION, RegisterBlock
from gripper.dynamixel.drive import SIGMAS, DriveCharacteristic
from gripper.dynamixel.models import ServoModel
from gripper.errors import BusUnreliable, ForceAboveCap, LimitExceeded
from gripper.mechanics.impact import (
    SLOWEST_M_S,
    ImpactLimit,
    closing_current_max_a,
    current_share,
    impact_limit,
)
from gripper.mechanics.transmission import CAP_SHARE, Mechanics, Transmission
from gripper.servos.motion import slow_rad_s
from gripper.settings import GripperSettings
from gripper.values.force_sensor import QUIET_N, ForceSample, RecentForce, mean_n
from gripper.values.state import ServoFeedback

_SURE_SAMPLES = 2
"""Newest samples whose mean is compared with the cap where another measurement excludes noise."""
_SINGLE_SAMPLE = 3.0
"""Largest factor of ``force_noise_n`` by which a few samples must exceed the cap to trip it. The
factor grows with their noise over that of the mean."""
_ROUNDING_A = 0.005
"""Tolerance in A of a goal current above its cap: two counts of 2.69 mA."""
EQUAL = 1e-9
"""Difference, in A or rad, that counts as equal."""
_EQUAL_ANGLE_RAD = 1e-6
"""Difference of angles in rad that counts as inside the range; a pulse is 1.5e-3 rad."""
_MOTION_RESERVE, _MOTION_PULSES = 1.5, 8.0
"""Factor and pulses by which a goal lies farther than at rest, to compensate for the motion."""

GOAL_BLOCK = RegisterBlock.between(GOAL_CURRENT, GOAL_POSITION)
"""Registers that one write of goals sets, 102 to 119, in the order of their addresses."""

MOST_STICTION = 2.0
"""Largest friction at rest over that in motion, of an XL330 (arXiv 2410.08650)."""
_PUSH_PERIODS = 2
"""Periods between two pushes beyond friction in motion: a push lasts one period. [chosen]"""
_RESERVE_N = 1.5
"""Force in N for the moving mass in addition to the set-point, for the rate of a ramp. [tuned]"""
_RUNNING_SHARE = 1.25
"""Rate of the opening over ``runaway_speed_m_s`` up to which a set-point does not limit it."""
BEYOND_MIDDLE_M = 0.005
"""Largest distance in m of a finger beyond the middle, if the other finger makes room. [chosen]"""
OPENING_MARGIN_RAD = 0.05
"""Largest distance in rad of a goal beyond its opening: friction stops fingers short of a goal."""


class ServoGoal(NamedTuple):
    """Goal of one servo in current-based position mode."""

    angle_rad: float
    """Goal position in the linkage's sense."""
    current_a: float
    """Limit of the current's magnitude."""
    setpoint_n: float | None = None
    """Present set-point of the grip force in N; None while fingers move and press on no part."""
    profile_rad_s: float = 0.0
    """Profile Velocity (register 112) in rad/s; 0 is no limit."""
    rest: "ServoGoal | None" = None
    """Goal that keeps the present force where no further one follows; None: this goal."""

    @property
    def lasting(self) -> "ServoGoal":
        """The goal that stays after an error."""
        return self.rest or self


def standing(
    goals: Sequence[ServoGoal], state: ServoFeedback, share: float = 1.0
) -> tuple[ServoGoal, ...]:
    """Return goals at the present positions, with a share of the currents.

    No finger pushes on, and none yields by more than position control of the servos does.
    """
    return tuple(
        goal._replace(angle_rad=angle_rad, current_a=share * goal.current_a)
        for goal, angle_rad in zip(goals, state.angles_rad, strict=True)
    )


class GoalWriter:
    """Writer of the goals, with their limits: force, current, angle, speed, temperature, age.

    It keeps the goals that are in force.
    """

    def __init__(self, bus: ServoBus, mechanics: Mechanics, clock: Clock) -> None:
        self.last: tuple[ServoGoal, ...] = ()
        """The goals written last, one for each servo; empty while no goal is in force."""
        self.asked: tuple[ServoGoal, ...] = ()
        """The last goals as they were asked for: those that were written may brake."""
        self.raws: dict[int, list[int]] = {}
        """The last contents of the goals' registers, by the servos' IDs, in their order."""
        settings, linkage = mechanics.settings, mechanics.linkage
        self._bus, self._mechanics, self._clock = bus, mechanics, clock
        self._settings, self._linkage = settings, linkage
        self.newest_force: ForceSample | None = None
        """The newest force sample; None before the first one."""
        self._forces = RecentForce()
        self._stood_a: dict[int, float] = {}
        self._pushes: dict[int, int] = {}
        self._previous_a = [-inf] * linkage.n_servos
        # Two apertures bound the angles. One is wide open. The other is closed, with the goal as
        # far beyond as a gripping servo needs.
        self._open_rad = linkage.angles_rad(settings.aperture_open_m)
        self._lowest_rad = most_closed_rad(mechanics)
        self._pads = 0.5 * linkage.n_servos

    def forget(self) -> None:
        """Discard the last goals: they are no longer in force."""
        self.last = ()

    def write(
        self, goals: Sequence[ServoGoal], state: ServoFeedback, *, final: bool = False
    ) -> None:
        """Write goal current and goal position of all servos at once, within all limits.

        This is the only place that writes goals.

        Parameters
        ----------
        state
            Newest feedback: the start of the motion to the goals.
        final
            True where no other goals may follow.
        """
        self.asked = tuple(goals)
        goals = [
            goal if goal.current_a <= servo.limit_a else goal._replace(current_a=servo.limit_a)
            for goal, servo in zip(goals, state.servos, strict=True)
        ]
        goals = self.bounded(goals, state, final=final)
        self.check(goals, state)
        values: dict[int, list[int]] = {}
        for goal, servo, settings in zip(goals, state.servos, self._settings.servos, strict=True):
            # Relative to the present position: whole turns of the count do not matter.
            model = settings.servo_model
            delta_rad = (goal.angle_rad - servo.angle_rad) * settings.direction
            side = copysign(1.0, goal.angle_rad - servo.angle_rad)
            against_rad_s = max(0.0, -side * servo.velocity_rad_s)
            goal_current = model.current_counts(goal.current_a, servo.supply_v, against_rad_s)
            least_raw, most_raw = model.goal_range_raw
            if not least_raw <= servo.position_raw <= most_raw:
                raise LimitExceeded(
                    f"servo {servo.servo_id} stands at {servo.position_raw}, a {model.name} takes "
                    f"goals from {least_raw} to {most_raw} only: switch its supply off and push "
                    "its finger back by hand"
                )
            goal_position = servo.position_raw + round(delta_rad / model.rad_per_pulse)
            # A servo would refuse a goal beyond, and no servo answers this write.
            goal_position = min(max(goal_position, least_raw), most_raw)
            values[servo.servo_id] = [
                min(round(goal_current), model.current_limit_raw),
                model.goal_velocity_raw,
                0,  # no limit of the acceleration
                round(goal.profile_rad_s / model.velocity_unit_rad_s),
                goal_position,
            ]
        self.raws = values
        self._bus.sync_write(values, GOAL_BLOCK)
        self.last = tuple(goals)

    def note_force(self, sample: ForceSample | None) -> None:
        """Add the newest force sample, if it shows a force; the same sample may come again."""
        if sample is None or not (sample.valid or sample.at_least):
            return
        newest = self.newest_force
        if newest is not None and sample.t_s - newest.t_s > self._settings.force_stale_s:
            self._forces.clear()  # those before a pause do not show the present force
        if self._forces.push(sample) is not None:
            self.newest_force = sample

    @property
    def fresh_force(self) -> ForceSample | None:
        """The newest force sample; None where it is older than ``force_stale_s``."""
        sample, longest_s = self.newest_force, self._settings.force_stale_s
        fresh = sample is not None and self._clock.monotonic() - sample.t_s <= longest_s
        return sample if fresh else None

    def bounded(
        self, goals: Sequence[ServoGoal], state: ServoFeedback, *, final: bool = False
    ) -> tuple[ServoGoal, ...]:
        """Return the goals, limited so that no closing finger presses or runs beyond its limits.

        Samples of the pads never raise the current. A finger presses with no more than the
        set-point, friction, the possible error of the drive and the force for the moving mass. For
        one period of three it may also overcome friction at rest. Without a set-point it presses
        below the cap, as an approach does. A finger is braked if it closes faster than the force
        left below the cap allows (`gripper.mechanics.impact`). While nothing presses on its pad,
        its goal lies no farther ahead than that speed needs. The servo's position controller keeps
        to it between two writes; a profile does too. Brakes that are ``final`` hold the finger
        where it is: their small current would let the part push it. The current of final goals
        swings from the measured force to less than the cap.
        """
        return tuple(
            self._closing(index, goal, state, final=final)
            if goal.angle_rad < servo.angle_rad
            else goal
            for index, (goal, servo) in enumerate(zip(goals, state.servos, strict=True))
        )

    def _most_a(self, servo_id: int, goal: ServoGoal, path: Transmission) -> float:
        if goal.setpoint_n is None:
            stood_a = self._stood_a.get(servo_id, 0.0)
            return closing_current_max_a(self._settings, path, stood_a=stood_a)
        asked_n = exp(SIGMAS * path.drive.load_sd) * goal.setpoint_n + _RESERVE_N
        asked_a = asked_n / path.n_per_a + path.drive.breakaway_a
        waits = self._pushes.get(servo_id, 0)
        pushes = waits <= 0 and goal.rest is not None and goal.current_a > asked_a
        self._pushes[servo_id] = _PUSH_PERIODS if pushes else waits - 1
        if pushes:
            stiction = MOST_STICTION / current_share(self._settings.period_s)
            asked_a += (stiction - 1.0) * path.drive.breakaway_a
        most_n = CAP_SHARE * self._settings.force_max_n
        return min(asked_a, path.pressing_current_a(most_n))

    def _closing(
        self, index: int, goal: ServoGoal, feedback: ServoFeedback, *, final: bool
    ) -> ServoGoal:
        """Return the goal of a finger that closes, with its current and its speed bounded."""
        state, model = feedback.servos[index], self._settings.servos[index].servo_model
        impact = impact_limit(self._mechanics, feedback.angles_rad)
        path = self._mechanics.transmissions(feedback.angles_rad)[index]
        forces_n = (0.0, 0.0) if self.newest_force is None else self.newest_force.force_n
        force_n = forces_n[index] if len(feedback.servos) > 1 else min(forces_n)
        empty = force_n < self._settings.contact_force_n
        if empty and max(abs(state.velocity_rad_s), abs(state.motor_rad_s)) <= slow_rad_s(model):
            stood_a = self._stood_a.get(state.servo_id, 0.0)
            self._stood_a[state.servo_id] = max(stood_a, -state.current_a)
        reach_m = self._pads * self._linkage.opening_per_rad_m(state.angle_rad)
        most_a = min(goal.current_a, self._most_a(state.servo_id, goal, path))
        if final and (sample := self.fresh_force) is not None:
            # A sudden drive swings from the force at rest to as far beyond the drive.
            swings_n = 0.5 * (impact.most_n + max(0.0, *sample.force_n))
            most_a = min(most_a, path.loading_current_a(swings_n))
        fastest_m_s = impact.pad_speed_m_s(None if empty else force_n)
        if empty:
            # No approach is slower. Until the finger has shown friction, current is the limit.
            fastest_m_s = max(fastest_m_s, 0.5 * SLOWEST_M_S)
        if goal.setpoint_n is not None:
            fastest_m_s = min(
                fastest_m_s, pressing_speed_m_s(self._settings, impact, goal.setpoint_n)
            )
        fastest_rad_s = fastest_m_s / reach_m
        # The speed of the next reading has noise: on a part it would disturb the force.
        speed_rad_s = state.next_rad_s if empty else state.velocity_rad_s
        # A motor that runs onto a part draws current. Where it reads none, the reading is wrong.
        motor_rad_s = state.motor_rad_s if empty or state.current_a < 0.0 else 0.0
        over_rad_s = -min(speed_rad_s, motor_rad_s) - fastest_rad_s
        if over_rad_s > slow_rad_s(model):
            if final:
                return goal._replace(angle_rad=state.angle_rad, current_a=most_a)
            # Only the excess momentum is removed, or the finger would swing. Friction does a part.
            drive_n = force_n + path.drive.least_breakaway_a * path.n_per_a
            drive_n -= impact.mass_kg * over_rad_s * reach_m / self._settings.period_s
            current_a = min(abs(drive_n) / path.n_per_a, most_a)
            angle_rad = goal.angle_rad if drive_n > 0.0 else state.angle_rad
            return goal._replace(angle_rad=angle_rad, current_a=current_a)
        angle_rad = goal.angle_rad
        if empty and goal.profile_rad_s == 0.0:
            ahead_rad = closing_margin_rad(model, most_a)
            ahead_rad += running_lead_rad(model, 0.0, fastest_rad_s)
            angle_rad = max(angle_rad, state.angle_rad - ahead_rad)
        return goal._replace(angle_rad=angle_rad, current_a=most_a)

    @property
    def newest_forces_n(self) -> tuple[float, float]:
        """Mean of the newest samples in N on finger 0 and finger 1; 0 without one."""
        return mean_n([sample.force_n for sample in islice(self._forces, _SURE_SAMPLES)])

    def force_is_too_high(self) -> bool:
        """Return whether the measured force is above the cap by more than noise.

        The allowance for noise falls with the number of samples: a large excess shows in the first
        sample.
        """
        settings, n_samples = self._settings, len(self._forces)
        first_n = second_n = variance_n2 = 0.0
        for n, sample in enumerate(self._forces, 1):
            first_n += sample.force_n[0]
            second_n += sample.force_n[1]
            variance_n2 += sample.noise_n**2
            excess_n = max(first_n, second_n) / n - settings.force_max_n
            if excess_n <= 0.0:
                continue
            few = n < n_samples
            times = min(_SINGLE_SAMPLE, sqrt(variance_n2) / n / QUIET_N) if few else 1.0
            if excess_n > times * settings.force_noise_n:
                return True
        return False

    def check_force(self, *, noise_excluded: bool = False) -> None:
        """Raise ForceAboveCap while the measured force is above the cap.

        With ``noise_excluded`` another measurement has excluded noise: then the cap has no
        allowance for it.
        """
        settings = self._settings
        if noise_excluded:
            too_high = max(self.newest_forces_n) > settings.force_max_n
        else:
            too_high = self.force_is_too_high()
        if too_high:
            raise ForceAboveCap(
                f"the grip force is {max(self._forces.newest.force_n):.2f} N, force_max_n is "
                f"{settings.force_max_n} N (and {settings.force_noise_n} N for noise): "
                f"currents that can press so much are lowered, the part is kept; check part and "
                f"pads, clear the fault, then release the part"
            )

    def check(self, goals: Sequence[ServoGoal], state: ServoFeedback) -> None:
        """Check goals before they are written; the next goals are compared with those that pass.

        Raises LimitExceeded, which names the limit, when a goal exceeds one. Raises BusUnreliable
        for old feedback.
        """
        settings = self._settings
        age_s = self._clock.monotonic() - state.t_s
        if age_s > settings.bus_loss_s:
            raise BusUnreliable(
                f"the servos' feedback is {age_s:.3f} s old, at most {settings.bus_loss_s} s are "
                f"allowed: check the servo bus"
            )
        lowering = opening = True
        for index, (goal, servo) in enumerate(zip(goals, state.servos, strict=True)):
            self._check_goal(index, goal, state)
            lowering &= goal.current_a <= self._previous_a[index] + EQUAL
            opening &= goal.angle_rad >= servo.angle_rad - EQUAL
        if not lowering and not opening:
            paths = self._mechanics.transmissions(state.angles_rad)
            for servo, path, goal in zip(state.servos, paths, goals, strict=True):
                least_n = goal.current_a * path.n_per_a - path.friction_n
                if goal.angle_rad < servo.angle_rad and least_n > settings.force_max_n:
                    raise LimitExceeded(
                        f"goal current {goal.current_a:.3f} A of servo {servo.servo_id} makes at "
                        f"least {least_n:.1f} N, force_max_n is {settings.force_max_n} N "
                        f"({_positions(state)})"
                    )
            check_temperature(settings, state)
            if self.fresh_force is not None:
                self.check_force()
        self._previous_a = [max(goal.current_a, goal.lasting.current_a) for goal in goals]

    def _check_goal(self, index: int, goal: ServoGoal, state: ServoFeedback) -> None:
        settings = self._settings
        servo = settings.servos[index]
        if not 0.0 <= goal.current_a <= settings.current_max_a + _ROUNDING_A:
            raise LimitExceeded(
                f"goal current {goal.current_a:.3f} A of servo {servo.servo_id} is not from 0 to "
                f"current_max_a = {settings.current_max_a} A"
            )
        low_rad = self._lowest_rad[index]
        if low_rad <= goal.angle_rad <= self._open_rad[index]:
            return
        overrun = overrun_rad(servo.servo_model, self._mechanics.drives.of(servo))
        high_rad = self._open_rad[index] + max(OPENING_MARGIN_RAD, 1.1 * overrun)
        # Fingers that stand outside (moved by hand, or past the end) may stay or be brought back
        # in; the reading of a finger at rest jitters by a count.
        angle_rad, count_rad = state.servos[index].angle_rad, servo.servo_model.rad_per_pulse
        lowest_rad = min(low_rad - _EQUAL_ANGLE_RAD, angle_rad - count_rad)
        highest_rad = max(high_rad + _EQUAL_ANGLE_RAD, angle_rad + count_rad)
        if not lowest_rad <= goal.angle_rad <= highest_rad:
            raise LimitExceeded(
                f"goal angle {goal.angle_rad:.4f} rad of servo {servo.servo_id} is not from "
                f"{low_rad:.4f} to {high_rad:.4f} rad (closed to aperture_open_m; "
                f"{_positions(state)})"
            )


def check_temperature(settings: GripperSettings, state: ServoFeedback) -> None:
    """Raise LimitExceeded for a servo that is too warm to press; its own limit drops the part."""
    if state.temperature_c > settings.temperature_max_c:
        hot = max(state.servos, key=lambda servo: servo.temperature_c)
        raise LimitExceeded(
            f"servo {hot.servo_id} has {hot.temperature_c:.0f} C, temperature_max_c is "
            f"{settings.temperature_max_c:g}: take out a part that is held, and let it cool down"
        )


def _positions(state: ServoFeedback) -> str:
    """Return the reported positions of all servos: a goal of one follows from those of both."""
    positions = (f"servo {servo.servo_id} at {servo.angle_rad:.4f} rad" for servo in state.servos)
    return f"by the positions that all report: {', '.join(positions)}; check encoders and horns"


def pressing_speed_m_s(settings: GripperSettings, impact: ImpactLimit, setpoint_n: float) -> float:
    """Return the largest speed of a pad in m/s at a set-point in N, independent of the pads.

    The force of the drive leaves the rest below the cap for momentum. Fingers that run freely
    without a part keep enough speed to be detected.
    """
    runs_m_s = 0.5 * _RUNNING_SHARE * settings.runaway_speed_m_s
    return max(impact.pad_speed_m_s(impact.load_share * setpoint_n + _RESERVE_N), runs_m_s)


def most_closed_rad(mechanics: Mechanics) -> tuple[float, ...]:
    """Return the most closed goal of each servo in rad: pads that meet, at the largest current.

    Fingers with a servo each may meet beside the middle.
    """
    settings, linkage = mechanics.settings, mechanics.linkage
    aside_m = (linkage.n_servos - 1) * BEYOND_MIDDLE_M
    return tuple(
        angle_rad
        - aside_m / linkage.opening_per_rad_m(angle_rad)
        - closing_margin_rad(servo.servo_model, settings.current_max_a)
        for angle_rad, servo in zip(linkage.angles_rad(0.0), settings.servos, strict=True)
    )


def closing_margin_rad(model: ServoModel, current_a: float) -> float:
    """Return the distance in rad of a goal beyond the contact at which a current limit is reached.

    A reserve of a half and a few pulses compensate for the motion.
    """
    at_rest_rad = running_lead_rad(model, current_a, 0.0)
    return _MOTION_RESERVE * at_rest_rad + _MOTION_PULSES * model.rad_per_pulse


def running_lead_rad(model: ServoModel, current_a: float, speed_rad_s: float) -> float:
    """Return the lead of the goal in rad of a servo that runs steadily with a current.

    Mode 5 makes P/K counts of Goal Current for each pulse of error (e-Manual, Position PID Gain).
    Its D gain takes a share for the speed. Both signs are those of the lead.
    """
    _, _, position_p_gain = model.position_gains
    counts = copysign(model.current_counts(abs(current_a)), current_a)
    counts += model.damping_a_s * speed_rad_s / model.current_unit_a
    return counts * model.error_per_pwm / position_p_gain * model.rad_per_pulse


def overrun_rad(model: ServoModel, drive: DriveCharacteristic) -> float:
    """Return the distance in rad of a goal beyond an opening, so that friction stops no finger."""
    breaking_a = MOST_STICTION * drive.breakaway_a
    return max(0.6 * OPENING_MARGIN_RAD, running_lead_rad(model, breaking_a, 0.0))
