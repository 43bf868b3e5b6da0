"""Motions of fingers that hold nothing: they stand still, and they move to an opening."""

from math import inf

from gripper.errors import FeedbackImplausible, PositionContradicted, ServoFault
from gripper.force.approach.mechanics_proof import (
    PATIENCE_S,
    REACHED_PULSES,
    ForceRise,
    mechanics_text,
)
from gripper.force.loop import Action, Moment
from gripper.mechanics.impact import closing_current_max_a, closing_speed_m_s
from gripper.mechanics.kinematics import Linkage, motion_currents_a, transmissions
from gripper.servos.goal_limits import ServoGoal, overrun_rad, running_lead_rad
from gripper.servos.motion import slow_rad_s
from gripper.settings import GripperSettings
from gripper.values.state import ServoFeedback

_STANDING_S = 0.2
"""Time in s for which empty fingers must stand after their torque has come on: friction at rest
makes a motor slow to start. [chosen]"""
_STANDING_RAD = 0.03
"""Travel in rad in that time of a moving finger: 2 mm with links of 60 mm. [resolution]"""
_SHORTEST_TRAVEL_M = 1e-3
"""Least planned travel of a motion in m. [chosen]"""
_OPENING_FORCE_N = 3.0
"""Force in N beside friction that the current of an opening allows: pads may stick to a part.
[chosen]"""
_RISING_S = 0.25
"""Time in s of its rise from the current that moves the fingers: if they close instead, the pads
show it before. [chosen]"""
BOOST_PER_S = 2.0
"""Growth in 1/s of the factor on the current of fingers that stand still untouched. [tuned]"""
_AGAINST_REST = 1.4
"""Current of a motion over that which moves the fingers freely: friction at rest is larger.
[assumed]"""


class StandStill:
    """Step of control that watches empty fingers whose torque has just come on: none may move.

    A servo with a wrong reported position runs to a goal made from it, or, where friction holds
    the finger, drives with more current than its distance from that goal explains.

    Parameters
    ----------
    settings
        Of the gripper.
    state
        Feedback at the start; the goals are these positions.
    """

    def __init__(self, settings: GripperSettings, state: ServoFeedback) -> None:
        self._models = [one.servo_model for one in settings.servos]
        self._start_rad = state.angles_rad
        self._periods = self._left = round(_STANDING_S / settings.period_s)
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
            drives = away_rad > abs(moved_rad) + REACHED_PULSES * model.rad_per_pulse
            if abs(moved_rad) > _STANDING_RAD or (done and drives):
                raise FeedbackImplausible(
                    f"servo {servo.servo_id}: it has moved by {moved_rad:+.3f} rad, with "
                    f"{mean_a:+.3f} A, although its goal is the position that it reported: the "
                    f"reported position is wrong, or something drives it, so the torque is "
                    f"switched off. Restart the servo, check its encoder and other programs on "
                    f"its line"
                )
        return Action(done=done)


class MoveTo:
    """Step of control that moves all servos evenly to an opening.

    Parameters
    ----------
    settings, linkage
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
        settings: GripperSettings,
        linkage: Linkage,
        state: ServoFeedback,
        *,
        aperture_m: float,
        speed_m_s: float | None = None,
        only_open: bool = False,
    ) -> None:
        self._settings = settings
        self._linkage = linkage
        self._only_open = only_open
        self._rise = ForceRise()
        self._start_rad = state.angles_rad
        self._target_rad = linkage.angles_rad(aperture_m)
        if only_open:
            self._target_rad = tuple(map(max, self._target_rad, self._start_rad))
            aperture_m = linkage.aperture_m(self._target_rad)
        travel_m = max(abs(aperture_m - state.aperture_m), _SHORTEST_TRAVEL_M)
        opening = aperture_m >= state.aperture_m
        if opening:
            speed_m_s = speed_m_s or settings.open_speed_m_s
        else:
            fastest_m_s = closing_speed_m_s(settings, linkage, state.angles_rad)
            speed_m_s = min(speed_m_s or settings.approach_speed_m_s, fastest_m_s)
        force_n = _OPENING_FORCE_N if opening else settings.approach_force_n
        paths = transmissions(settings, linkage, state.angles_rad)
        needed_a = motion_currents_a(settings, paths, force_n)
        self._least_a = motion_currents_a(settings, paths, 0.0)
        # The same current makes more force at wider openings.
        self._most_a = [
            settings.current_max_a
            if opening
            else closing_current_max_a(settings, path, stood_a=inf)
            for path in paths
        ]
        self._currents_a = [
            min(_AGAINST_REST * current_a, most_a)
            for current_a, most_a in zip(needed_a, self._most_a, strict=True)
        ]
        self._stiff = [path.drive.most_breakaway_a / path.drive.breakaway_a for path in paths]
        self._boosts = [1.0] * len(paths)
        self._rising_s = _RISING_S if opening else 0.0
        self._passed_s = 0.0
        self._share_per_s = speed_m_s / travel_m
        self._share = 0.0
        self._aperture_m = aperture_m
        self._deadline_s = state.t_s + travel_m / speed_m_s + PATIENCE_S

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period.

        Raises
        ------
        PositionContradicted
            When the force on the pads grows although the fingers only open.
        ServoFault
            When a finger does not arrive in time.
        """
        pressed = self._rise.found(moment) if self._only_open else ""
        if pressed:
            raise PositionContradicted(
                f"{pressed} while the fingers open: they close, or something pushes them "
                f"together. They stand still; take the part out by hand, then check "
                f"{mechanics_text(self._settings, self._linkage)}"
            )
        self._share = min(1.0, self._share + self._share_per_s * moment.dt_s)
        self._passed_s += moment.dt_s
        rising = self._passed_s / self._rising_s if self._passed_s < self._rising_s else 1.0
        goals = []
        arrived = True
        for finger, (settings, servo, start_rad, target_rad) in enumerate(
            zip(
                self._settings.servos,
                moment.state.servos,
                self._start_rad,
                self._target_rad,
                strict=True,
            )
        ):
            sign = 1.0 if target_rad >= start_rad else -1.0
            reached_rad = REACHED_PULSES * settings.servo_model.rad_per_pulse
            there = sign * (target_rad - servo.angle_rad) <= reached_rad
            there = there or (self._only_open and start_rad >= target_rad)
            arrived = arrived and there
            drive = self._settings.drives.of(settings.servo_id, settings.drive)
            end_rad = target_rad + sign * overrun_rad(settings.servo_model, drive)
            angle_rad = (
                servo.angle_rad if there else start_rad + self._share * (end_rad - start_rad)
            )
            if self._only_open:
                angle_rad = max(angle_rad, servo.angle_rad)
            stands = abs(servo.velocity_rad_s) <= slow_rad_s(settings.servo_model)
            more = BOOST_PER_S * moment.dt_s if stands and not there and rising == 1.0 else 0.0
            self._boosts[finger] = min(self._boosts[finger] + more, self._stiff[finger])
            least_a, current_a = self._least_a[finger], self._currents_a[finger]
            current_a = min(current_a, least_a + rising * (current_a - least_a))
            current_a = min(self._boosts[finger] * current_a, self._most_a[finger])
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=current_a))
        if not arrived and moment.now_s > self._deadline_s:
            raise self._stuck(moment.state)
        return Action(goals=goals, done=arrived)

    def _stuck(self, state: ServoFeedback) -> ServoFault:
        slowest = max(
            zip(state.servos, self._target_rad, strict=True),
            key=lambda pair: abs(pair[1] - pair[0].angle_rad),
        )[0]
        return ServoFault(
            slowest.servo_id,
            0,
            f"its finger is stuck: the gripper stands at {state.aperture_m * 1e3:.1f} mm on its "
            f"way to {self._aperture_m * 1e3:.1f} mm; if nothing blocks it, check "
            f"{mechanics_text(self._settings, self._linkage)}",
        )
