"""Motions of fingers that hold nothing: they stand still, and they move to an opening."""

from math import inf

from gripper import errors
from gripper.force.approach.mechanics_proof import mechanics_text
from gripper.force.certainty import BRIEF_S, STEADY_S
from gripper.force.loop import Action, Moment
from gripper.mechanics.impact import closing_current_max_a, closing_speed_m_s
from gripper.mechanics.transmission import BOOST_PER_S, OPENING_N, Mechanics, Transmission
from gripper.servos.goal_limits import (
    ServoGoal,
    closing_margin_rad,
    most_closed_rad,
    overrun_rad,
    running_lead_rad,
)
from gripper.servos.motion import slow_rad_s, still_rad
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.force_sensor import LEAST_SAMPLES, RecentForce
from gripper.values.state import ServoFeedback, ServoState

_MOVED_RAD = 0.03
"""Travel in rad that excludes friction and backlash as the cause of a motion, or of a standstill:
2 mm with links of 60 mm. [chosen]"""
_REACHED_PULSES = 2.0
"""Distance in counts of the encoder at which a finger has reached its goal. [resolution]"""
_PATIENCE_S = 2.0
"""Time in s after which fingers without progress have not arrived. [chosen]"""
_RUN_RAD = 0.01
"""Travel in rad that shows that the current moves a finger: more than pads and backlash yield.
[resolution]"""
_LEAST_N = 0.5
"""Force in N beside friction that the least current allows. [chosen]"""
_LEAD_RAD = 0.04
"""Largest lead of a goal before its finger in rad: the least current is then at its limit.
[resolution]"""
_BLOCKED_S = 0.05
"""Time in s at the limit of its current after which a standing finger is blocked. [chosen]"""
_RISE_N, _RISE_SHARE = 1.0, 0.2
"""Rise of the grip force that an opening cannot cause: in N, or as a share of the first force if
that is more. [chosen]"""


class StandStill:
    """Step of control that watches empty fingers whose torque has just come on: none may move.

    A servo with a wrong reported position runs to a goal made from it. Where friction holds the
    finger, it drives with more current than its distance from that goal explains.

    Parameters
    ----------
    settings
        Of the gripper.
    state
        Feedback at the start; the goals are these positions.
    """

    def __init__(self, settings: GripperSettings, state: ServoFeedback) -> None:
        self._models = [servo.servo_model for servo in settings.servos]
        self._start_rad = state.angles_rad
        self._periods = self._left = round(2.0 * BRIEF_S / settings.period_s)
        self._sums_a = [0.0] * len(self._models)

    def step(self, moment: Moment) -> Action:
        """Return no goals. Raises FeedbackImplausible when a finger moves, or its motor drives."""
        self._left -= 1
        done = self._left <= 0
        for index, servo in enumerate(moment.state.servos):
            moved_rad, model = servo.angle_rad - self._start_rad[index], self._models[index]
            self._sums_a[index] += servo.current_a
            mean_a = self._sums_a[index] / self._periods
            away_rad = abs(running_lead_rad(model, mean_a, 0.0))
            drives = away_rad > abs(moved_rad) + _REACHED_PULSES * model.rad_per_pulse
            if abs(moved_rad) > _MOVED_RAD or (done and drives):
                raise errors.FeedbackImplausible(
                    f"servo {servo.servo_id}: it has moved by {moved_rad:+.3f} rad, with "
                    f"{mean_a:+.3f} A, although its goal is the position that it reported: the "
                    f"reported position is wrong, or something drives it, so the torque is "
                    f"switched off. Restart the servo, check its encoder and other programs on "
                    f"its line"
                )
        return Action(done=done)


class MoveTo:
    """Step of control that moves all servos to an opening, at the same speed.

    A closing motion waits while a finger runs open faster than its current can brake.

    Parameters
    ----------
    mechanics
        Of the gripper.
    state
        Feedback at the start.
    aperture_m
        Opening to reach in m.
    speed_m_s
        Rate of the opening in m/s; None: that of the settings. Closing fingers stay below the
        limit of the impact.
    only_open
        True if no finger may close, e.g. in a release: a finger that is more open stays there, and
        a finger pushed open is not driven back.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        state: ServoFeedback,
        *,
        aperture_m: float,
        speed_m_s: float | None = None,
        only_open: bool = False,
    ) -> None:
        settings, linkage = mechanics.settings, mechanics.linkage
        self._mechanics, self._settings = mechanics, settings
        self._only_open = only_open
        self._rise = _ForceRise()
        target_rad = linkage.angles_rad(aperture_m)
        if only_open:
            target_rad = tuple(map(max, target_rad, state.angles_rad))
        self._aperture_m = linkage.aperture_m(target_rad)
        self._opening = self._aperture_m >= state.aperture_m
        if self._opening:
            speed_m_s = speed_m_s or settings.open_speed_m_s
        else:
            fastest_m_s = closing_speed_m_s(mechanics, state.angles_rad)
            speed_m_s = min(speed_m_s or settings.approach_speed_m_s, fastest_m_s)
        self._rate_rad_s = speed_m_s / sum(map(linkage.opening_per_rad_m, state.angles_rad))
        least_rad = most_closed_rad(mechanics)
        self._fingers = list(map(_Finger, settings.servos, state.angles_rad, target_rad, least_rad))
        self._begun_s = state.t_s
        self._deadline_s = state.t_s + _PATIENCE_S
        self._set_currents(mechanics.transmissions(state.angles_rad))
        self._ran_s = state.t_s if self._coasts(state) else -inf

    def _set_currents(self, paths: tuple[Transmission, ...]) -> None:
        settings = self._settings
        force_n = settings.approach_force_n
        if self._opening:  # a weak hand opens with what its current allows
            force_n = min(OPENING_N, self._mechanics.loaded_n(paths))
        without_force_a = self._mechanics.motion_currents_a(paths, 0.0)
        currents_a = self._mechanics.motion_currents_a(paths, force_n)
        for finger, path, least_a, current_a in zip(
            self._fingers, paths, without_force_a, currents_a, strict=True
        ):
            # The same current makes more force at wider openings.
            finger.most_a = settings.current_max_a
            if not self._opening:
                finger.most_a = closing_current_max_a(settings, path)
            finger.least_a, finger.current_a = least_a, current_a
            finger.most_boost = path.most_boost if self._opening else inf

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period.

        Raises
        ------
        PositionContradicted
            When the force on the pads grows although the fingers only open.
        FingerBlocked
            When a finger does not arrive in time.
        """
        pressed = self._rise.growth(moment) if self._only_open else ""
        if pressed:
            raise errors.PositionContradicted(
                f"{pressed} while the fingers open: they close, or something pushes them "
                f"together. They stand still; take the part out by hand, then check "
                f"{mechanics_text(self._mechanics)}"
            )
        if moment.now_s < min(self._ran_s + BRIEF_S, self._deadline_s):
            if self._coasts(moment.state):
                self._ran_s = moment.now_s
            return Action()
        self._look(moment)
        passed_s = moment.now_s - self._begun_s
        # If the fingers close instead, the pads show it before the current is whole.
        rising = min(1.0, passed_s / STEADY_S) if self._opening else 1.0
        goals = []
        for finger, servo in zip(self._fingers, moment.state.servos, strict=True):
            angle_rad = finger.goal_rad(servo, moment.dt_s, self._rate_rad_s)
            if self._only_open:
                angle_rad = max(angle_rad, servo.angle_rad)
            stands = abs(servo.velocity_rad_s) <= slow_rad_s(finger.servo.servo_model)
            if stands and not finger.there and rising == 1.0:
                finger.boost = min(finger.boost + BOOST_PER_S * moment.dt_s, finger.most_boost)
            current_a = finger.least_a + rising * (finger.current_a - finger.least_a)
            current_a = min(finger.boost * current_a, finger.most_a)
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=current_a))
        arrived = all(finger.there for finger in self._fingers)
        if not arrived and moment.now_s > self._deadline_s:
            slowest = next(finger for finger in self._fingers if not finger.there)
            raise errors.FingerBlocked(
                f"servo {slowest.servo.servo_id}: its finger is stuck: the gripper stands at "
                f"{moment.state.aperture_m * 1e3:.1f} mm on its way to "
                f"{self._aperture_m * 1e3:.1f} mm; if nothing blocks it, check "
                f"{mechanics_text(self._mechanics)}",
                opens=self._opening,
            )
        return Action(goals=goals, done=arrived)

    def _coasts(self, state: ServoFeedback) -> bool:
        """Return whether a finger runs open too fast for the current of this closing motion."""
        if self._opening:
            return False
        for finger, servo in zip(self._fingers, state.servos, strict=True):
            drive = self._mechanics.drives.of(finger.servo)
            inertia_a_s2 = drive.inertia_a_s2(finger.servo.servo_model)
            way_rad = 0.5 * inertia_a_s2 * servo.velocity_rad_s**2 / finger.current_a
            if servo.velocity_rad_s > 0.0 and way_rad > _MOVED_RAD:
                return True
        return False

    def _look(self, moment: Moment) -> None:
        """Use the newest friction of each finger, and extend the time of fingers that run."""
        for finger, servo in zip(self._fingers, moment.state.servos, strict=True):
            drive = self._mechanics.drives.of(finger.servo)
            finger.overrun_rad = overrun_rad(finger.servo.servo_model, drive)
            if finger.comes_nearer(servo):
                self._deadline_s = moment.now_s + _PATIENCE_S


class FirstMotion(MoveTo):
    """Motion of empty fingers whose torque has just come on: it proves the mechanics.

    Each finger gets the least current that moves it. A finger that stands still at its limit tries
    the way back. If that is free, the finger is blocked, not held by friction; else its gearing is
    stiff, and it gets more current once. Its goal is then so far ahead that the current flows. With
    ``only_open`` a blocked finger does not try the way back.
    """

    def _set_currents(self, paths: tuple[Transmission, ...]) -> None:
        self._back: _Finger | None = None
        super()._set_currents(paths)
        currents_a = self._mechanics.motion_currents_a(paths, _LEAST_N)
        for finger, current_a in zip(self._fingers, currents_a, strict=True):
            finger.current_a, finger.lead_rad = current_a, _LEAD_RAD
            finger.most_a = min(self._settings.current_max_a, current_a * finger.most_boost)
            finger.turn(finger.from_rad)

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period; MechanicsContradicted when a finger is blocked."""
        servos = moment.state.servos
        pressed = self._rise.growth(moment)
        if self._back is None:
            self._stands_m = moment.state.aperture_m
        if not pressed and moment.now_s > self._deadline_s:
            pressed = "the fingers have not arrived in time"
        if pressed:
            raise self._contradicted(servos[0], pressed)
        self._look(moment)
        goals = []
        for finger, servo in zip(self._fingers, servos, strict=True):
            finger.moved |= finger.way_rad(servo) >= _RUN_RAD
            if self._back is not None and finger is not self._back:
                finger.turn(servo.angle_rad)
                angle_rad = servo.angle_rad
            else:
                back = finger is self._back
                angle_rad = finger.goal_rad(servo, moment.dt_s, self._rate_rad_s, back=back)
                if finger.still_s >= _BLOCKED_S:
                    self._turn(finger, servo)
                elif back and -finger.way_rad(servo) >= _MOVED_RAD:
                    raise self._contradicted(
                        servo, "it is blocked on its way, and free on its way back"
                    )
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=finger.current_a))
        return Action(goals=goals, done=all(finger.there for finger in self._fingers))

    def _turn(self, finger: "_Finger", servo: ServoState) -> None:
        """Turn a blocked finger round, or give it more current, or end the motion."""
        ran_freely = finger.way_rad(servo) >= _RUN_RAD
        finger.turn(servo.angle_rad)
        may_turn = finger.sign > 0.0 and not self._only_open
        if self._back is None and may_turn:
            self._back = finger
            return
        self._back = None
        # Where no way back is tried, it is enough that the finger has moved with this current.
        if finger.current_a == finger.most_a or (ran_freely and not may_turn):
            raise self._contradicted(servo, "it is blocked on its way")
        # A finger that has moved needs no more current.
        for other in self._fingers:
            if other is finger or not other.moved:
                other.current_a = other.most_a
                if not self._only_open:
                    other.still_s = 0.0  # it has not stood with this current yet
                    other.lead_rad = closing_margin_rad(other.servo.servo_model, other.most_a)

    def _contradicted(self, servo: ServoState, cause: str) -> errors.MechanicsContradicted:
        most_a = max(finger.current_a for finger in self._fingers)
        return errors.MechanicsContradicted(
            f"servo {servo.servo_id}: {cause}, at an opening of {self._stands_m * 1e3:.1f} mm on "
            f"its way to {self._aperture_m * 1e3:.1f} mm, with {most_a:.2f} A, the "
            f"least that moves it. So the settings do not match the position of the fingers, "
            f"something blocks them, or their friction is too high; the torque is switched off. "
            f"Look at the fingers, move them by hand, then check "
            f"{mechanics_text(self._mechanics)}"
        )


class _Finger:
    """One finger on its way: its goal, its current, and how long it has stood."""

    def __init__(
        self, servo: ServoSettings, start_rad: float, target_rad: float, least_rad: float
    ) -> None:
        self.servo = servo
        self.sign = 1.0 if target_rad >= start_rad else -1.0
        self.from_rad = start_rad
        self.lead_rad, self.overrun_rad = inf, 0.0
        """Largest lead of the goal, and its distance beyond the target by the newest friction."""
        self.least_a = self.current_a = self.most_a = 0.0
        self.boost = self.most_boost = 1.0
        self.still_s = 0.0
        """Time in s for which it has stood at the limit of its current."""
        self.there = self.moved = False
        self._least_rad = min(least_rad, start_rad)
        self._target_rad = target_rad
        self._goal_rad = self._nearest_rad = self._stood_rad = start_rad

    def turn(self, angle_rad: float) -> None:
        """Go on from an angle in rad, forwards or back."""
        self.from_rad = self._stood_rad = angle_rad
        self._goal_rad = angle_rad + 0.5 * self.sign * _LEAD_RAD
        self.still_s = 0.0

    def way_rad(self, servo: ServoState) -> float:
        """Return its way towards its target since `turn`."""
        return self.sign * (servo.angle_rad - self.from_rad)

    def comes_nearer(self, servo: ServoState) -> bool:
        """Return whether it is nearer to its target than ever, by more than pads yield."""
        nearer = self.sign * (servo.angle_rad - self._nearest_rad) >= _RUN_RAD
        if nearer:
            self._nearest_rad = servo.angle_rad
        return nearer

    def goal_rad(
        self, servo: ServoState, dt_s: float, rate_rad_s: float, *, back: bool = False
    ) -> float:
        """Return the goal of one period in rad; it runs ahead of the finger at a rate in rad/s."""
        model, angle_rad = self.servo.servo_model, servo.angle_rad
        left_rad = self.sign * (self._target_rad - angle_rad)
        self.there = not back and left_rad <= _REACHED_PULSES * model.rad_per_pulse
        if self.there:
            self.still_s, self._goal_rad = 0.0, angle_rad
            return angle_rad
        sign = -self.sign if back else self.sign
        most_rad = ahead_rad = max(self.lead_rad, self.overrun_rad)
        if not back:
            most_rad = min(most_rad, left_rad + self.overrun_rad)
            ahead_rad = sign * (self._goal_rad - angle_rad) + rate_rad_s * dt_s
        stands = abs(angle_rad - self._stood_rad) < still_rad(model)
        # A count of jitter is no motion.
        at_limit = ahead_rad >= most_rad - model.rad_per_pulse
        self.still_s = self.still_s + dt_s if stands and at_limit else 0.0
        if self.still_s == 0.0:
            self._stood_rad = angle_rad
        goal_rad = angle_rad + sign * min(ahead_rad, most_rad)
        self._goal_rad = max(goal_rad, min(self._least_rad, angle_rad))
        return self._goal_rad


class _ForceRise:
    """Detector of a grip force that grows although the fingers open."""

    def __init__(self) -> None:
        self._recent = RecentForce()
        self._least_n = inf

    def growth(self, moment: Moment) -> str:
        """Add the newest sample; return by how much the force has grown as text, or nothing."""
        sample, recent = moment.sample, self._recent
        if sample is None or not sample.valid or recent.push(sample) is None:
            return ""
        if len(recent) < LEAST_SAMPLES:
            return ""
        self._least_n = min(self._least_n, recent.grip_n)
        if recent.grip_n - self._least_n < max(_RISE_N, _RISE_SHARE * self._least_n):
            return ""
        return f"the pads' force has grown from {self._least_n:.1f} to {recent.grip_n:.1f} N"
