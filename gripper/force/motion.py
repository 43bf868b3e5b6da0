"""Motions of the fingers without a part: to an opening, and closing until the pads are touched."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from math import inf, sqrt

from gripper.dynamixel.control_table import RAD_S_PER_VELOCITY_UNIT
from gripper.errors import FeedbackImplausible, PositionContradicted, ServoFault
from gripper.force.controller import History
from gripper.force.loop import Action, Moment
from gripper.force.mechanics_proof import (
    OVERRUN_RAD,
    REACHED_RAD,
    ForceRise,
    mechanics_text,
)
from gripper.impact import approach_speed_m_s, closing_current_max_a, slowing_way_m
from gripper.kinematics import Linkage, motion_current_a, transmissions
from gripper.recent import RecentForce
from gripper.servos.goals import (
    ServoGoal,
    closing_margin_rad,
    running_lead_rad,
)
from gripper.settings import GripperSettings
from gripper.state import ForceSample, GripperState

# Figures without another source are tuned in the simulated cell, with friction up to 20 % off.
_MOVE_PATIENCE_S = 2.0
"""Time in s beyond that of the motion after which a finger counts as stuck."""
_STANDING_S = 0.2
"""Time in s for which empty fingers must stand after their torque has come on: friction at rest
makes a motor slow to start."""
_STANDING_RAD = 0.03
"""Way in rad in that time that is no standing any more: 2 mm of a finger of 60 mm."""
_SHORTEST_TRAVEL_M = 1e-3
"""Way in m that a motion is planned for at least."""
_OPENING_FORCE_N = 3.0
"""Force in N beside friction that the current of an opening allows: pads may stick to a part."""
_RISING_S = 0.25
"""Time in s in which it rises to that from what moves the fingers: where they close instead, the
pads show it before."""
_AGAINST_REST = 1.4
"""Current of a motion over that which moves the fingers freely: friction at rest is larger."""

STALL_SPEED_M_S = 0.002
"""Rate of the opening in m/s below which the fingers stand still."""
_STALL_CURRENT_SHARE = 0.8
"""Share of the goal current from which on a servo that stands still pushes against something."""
_STALL_TIME_S = 0.5
"""Time in s for which both must last before the fingers are stalled."""
LEAD_M = 0.006
"""How far in m the goal runs ahead of the fingers: how far they go on if nobody writes again."""
_STARTING_S = 0.1
"""Longest time in s in which fingers get to their speed; with more friction than their model's the
goal runs on."""
_RUNNING_SHARE = 0.8
"""Share of the nominal speed from which on a finger runs, and the inverse of the fastest one."""
_SLOWED_SHARE = 0.6
"""Share of the nominal speed below which a running finger has been slowed down by something."""
_SLOWEST_RAD_S = 4.0 * RAD_S_PER_VELOCITY_UNIT
"""Nominal speed in rad/s below which a slowed finger does not stand out of the grain of 0.024."""
_PAUSE_S = 0.15
"""Time in s for which a slowed finger waits for the pads: their delay and three samples."""
LARGEST_BOOST = 1.6
"""Largest factor on the current of fingers that stand still untouched."""
BOOST_PER_S = 2.0
"""Growth of that factor in 1/s; it falls twice as fast."""
_YOUNG_S = 0.015
"""Age in s up to which a first touch is still worth braking for; later the part itself and friction
have stopped the finger."""
_TOUCH_N = 0.12
"""Least force in N on a pad that shows a first touch, however quiet the empty pad is."""
_TOUCH_SIGMAS = 3.5
"""A first touch stands out of the noise of the empty pad by so many standard deviations."""
_EMPTY_SAMPLES = 20
"""Samples over which the noise of an empty pad is taken."""
_TOUCH_SAMPLES = 8
"""Newest samples, at most, whose mean is compared with it; older ones are of the empty pad."""
_BRAKED_S = 0.01
"""Time in s for which a braked finger is stopped before it goes on slowly."""
_DOUBT_S = 0.05
"""Time in s after which a braked finger whose pad shows nothing runs on."""
_CREEP_N_S, _LATE_CREEP_N_S = 20.0, 4.0
"""Rate in N/s at which the drive of a braked finger grows: up to a little more than the force of a
contact, and beyond."""
_CREEP_RESERVE_N = 0.2
"""That little more in N: friction at rest is larger than in motion."""
_SOFT_M = 0.0002
"""Way in m of a braked finger after which it runs on: a part that yields so far without the force
of a contact is soft, and no impact is to be feared."""
_SURE_SHARE = 0.5
"""Share of the force of a contact from which on the mean on the pad of a braked finger is one: it
has stopped at what it touched."""
_WRONG_FACTOR = 1.5
"""Factor on the force of a first touch after each one that was none."""
_LEAD_SHARE = 0.75
"""Share of its lead with which the goal of a finger runs on, so that the finger does not shoot."""
_CREEP_START_N = 0.2
"""Drive in N with which a braked finger begins: less than the pad pushes back with."""
_CREEP_RAD_S = 1.5 * RAD_S_PER_VELOCITY_UNIT
"""Speed in rad/s above which a braked finger has lost what it touched, and is stopped again."""
_FREE_TIME_S = 0.05
"""Time constant in s of the current that moves an empty finger."""
_CONTACT_QUIET_N, _CONTACT_LONGEST_S = 0.1, 0.018
"""Noise in N of the mean that shows a contact, and its longest time in s: one frame at 50 Hz."""
_REST_QUIET_N, _REST_QUIET_YOUNG_N = 0.08, 0.12
"""Noise in N of the mean that is the force at the contact; it ends the rest. Where the samples are
young the force is soon known better."""
_REST_SAMPLES, _REST_LONGEST_S = 4, 0.07
"""Samples of that mean where the sensor is too slow for it, and its longest time in s."""
_REST_SETTLING_S = 0.01
"""Time in s after the contact from which on its samples count."""


class StandStill:
    """Step of control that watches empty fingers whose torque has just come on: none may move.

    A servo that goes by another position than it reports runs to a goal made of the reported one.

    Parameters
    ----------
    settings
        Of the gripper.
    state
        Feedback at the start; the goals are these positions.
    """

    def __init__(self, settings: GripperSettings, state: GripperState) -> None:
        self._start_rad = state.angles_rad
        self._periods = round(_STANDING_S / settings.period_s)

    def step(self, moment: Moment) -> Action:
        """Return no goals; FeedbackImplausible when a finger leaves its place."""
        self._periods -= 1
        for servo, start_rad in zip(moment.state.servos, self._start_rad, strict=True):
            moved_rad = servo.angle_rad - start_rad
            if abs(moved_rad) > _STANDING_RAD:
                raise FeedbackImplausible(
                    f"servo {servo.servo_id}: it has moved by {moved_rad:+.3f} rad although the "
                    f"position that it reported is its goal: it goes by another position than it "
                    f"reports, or something drives it, so the torque is switched off. Restart the "
                    f"servo, check its encoder and who else writes to it"
                )
        return Action(done=self._periods <= 0)


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
    only_open
        True where no finger may close, as a release: one that is more open stays there, and none
        is driven back where something pushes it open.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: GripperState,
        *,
        aperture_m: float,
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
        speed_m_s = (
            settings.open_speed_m_s
            if opening
            else approach_speed_m_s(settings, linkage, state.angles_rad)
        )
        force_n = _OPENING_FORCE_N if opening else settings.approach_force_n
        paths = transmissions(settings, linkage, state.angles_rad)
        self._current_a = min(
            _AGAINST_REST * motion_current_a(settings, paths, force_n),
            # The wider the fingers stand, the more force a current makes.
            settings.current_max_a if opening else closing_current_max_a(settings, paths),
        )
        self._rising_s = _RISING_S if opening else 0.0
        self._least_a = motion_current_a(settings, paths, 0.0)
        self._passed_s = 0.0
        self._share_per_s = speed_m_s / travel_m
        self._share = 0.0
        self._aperture_m = aperture_m
        self._deadline_s = state.t_s + travel_m / speed_m_s + _MOVE_PATIENCE_S

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period.

        Raises
        ------
        PositionContradicted
            When the pads are pressed more and more though the fingers only open.
        ServoFault
            When a finger does not arrive in time.
        """
        pressed = self._rise.found(moment) if self._only_open else ""
        if pressed:
            raise PositionContradicted(
                f"{pressed} while the fingers let go: they close, or something pushes them "
                f"together. They stand still; take the part out by hand, then check "
                f"{mechanics_text(self._settings, self._linkage)}"
            )
        self._share = min(1.0, self._share + self._share_per_s * moment.dt_s)
        self._passed_s += moment.dt_s
        current_a = self._current_a
        if self._passed_s < self._rising_s:
            more = self._passed_s / self._rising_s
            current_a = min(current_a, self._least_a + more * (current_a - self._least_a))
        goals = []
        arrived = True
        for servo, start_rad, target_rad in zip(
            moment.state.servos, self._start_rad, self._target_rad, strict=True
        ):
            sign = 1.0 if target_rad >= start_rad else -1.0
            there = sign * (target_rad - servo.angle_rad) <= REACHED_RAD
            there = there or (self._only_open and start_rad >= target_rad)
            arrived = arrived and there
            end_rad = target_rad + sign * OVERRUN_RAD
            angle_rad = (
                servo.angle_rad if there else start_rad + self._share * (end_rad - start_rad)
            )
            if self._only_open:
                angle_rad = max(angle_rad, servo.angle_rad)
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=current_a))
        if not arrived and moment.now_s > self._deadline_s:
            raise self._stuck(moment.state)
        return Action(goals=goals, done=arrived)

    def _stuck(self, state: GripperState) -> ServoFault:
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


class ApproachEvent(Enum):
    """Result of a step of an approach: closing on, or how the approach has ended."""

    CLOSING = "closing"
    CONTACT = "contact"
    LIMIT = "limit"
    OBSTRUCTED = "obstructed"


class Approach:
    """Step of control that closes both fingers evenly; a finger that touches waits for the other.

    Where no part has begun so far the fingers travel, and slow down in time. The pads decide. A
    finger whose pad shows a first touch that is not old brakes to rest and then presses ever
    harder, until the contact is sure; where it has touched nothing, or the part is soft, it runs
    on. Where the fingers stand still at the current limit, one pad is enough (the other may be
    touched beside its taxels); without any pad the way is obstructed. The current grows by up to
    60 % while the fingers stand still untouched: friction at rest differs from servo to servo.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the start.
    widest_m
        Opening in m above which no part begins; None where that is not known.

    Attributes
    ----------
    event
        Result of the last step.
    braked_s
        Monotonic time in s of the newest first touch that braked a finger; that of the start
        before one.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: GripperState,
        *,
        widest_m: float | None = None,
    ) -> None:
        self.event = ApproachEvent.CLOSING
        self.braked_s = state.t_s
        self._settings = settings
        self._linkage = linkage
        paths = transmissions(settings, linkage, state.angles_rad)
        self._current_max_a = closing_current_max_a(settings, paths)
        self._slow_at_m = inf
        if widest_m is not None:
            self._slow_at_m = widest_m + slowing_way_m(
                settings,
                linkage,
                linkage.angles_rad(widest_m),
                from_m_s=approach_speed_m_s(settings, linkage, state.angles_rad, travelling=True),
                to_m_s=approach_speed_m_s(settings, linkage, state.angles_rad),
            )
        self._travels = state.aperture_m > self._slow_at_m
        self._speed_m_s = self._new_speed_m_s(state)
        self._closing_a = min(
            motion_current_a(settings, paths, settings.approach_force_n), self._current_max_a
        )
        self._boost = 1.0
        self._detector = ContactDetector(settings.contact_force_n, settings.contact_samples)
        self._aperture_m = state.aperture_m
        self._begins, self._slows = True, False
        self._started_s: float | None = None
        self._apertures = History()
        self._was_touched = False
        self._touch = FirstTouch()
        self._free_a = [path.friction_nm / path.kt_nm_a for path in paths]
        self._brakes: list[_Brake | None] = [None] * len(state.servos)
        self._soft = [False] * len(state.servos)
        self._waiting_rad: list[float | None] = [None] * len(state.servos)
        self._was_running = [False] * len(state.servos)
        self._pauses: list[tuple[float, float] | None] = [None] * len(state.servos)
        self._deadline_s = state.t_s + settings.contact_timeout_s
        self._moving_s = state.t_s

    @property
    def current_a(self) -> float:
        """Goal current of the servos now in A."""
        return min(self._closing_a * self._boost, self._current_max_a)

    @property
    def touch_m(self) -> float:
        """Opening in m at which both pads were first loaded, by the samples of the contact.

        The opening of now where a contact was found without them.
        """
        if not all(self._detector.touched):
            return self._apertures.newest
        return self._apertures.at(self._detector.first_s)

    def runs_freely(self, state: GripperState) -> bool:
        """Return whether all fingers close steadily and no pad has been touched so far."""
        nominal_rad_s = self._nominal_rad_s(state)
        return not self._was_touched and all(
            _RUNNING_SHARE <= -servo.velocity_rad_s / nominal_rad_s <= 1.0 / _RUNNING_SHARE
            for servo in state.servos
        )

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period; an end leaves the fingers where they are or touch."""
        state, sample = moment.state, moment.sample
        travelled = self._travels
        self._travels = travelled and state.aperture_m > self._slow_at_m and not self._was_touched
        self._speed_m_s = self._new_speed_m_s(state)
        self._slows |= travelled and not self._travels
        if self._starts(moment) or self._slows_down(state):
            self._aperture_m = state.aperture_m - self._lead_m(state)
        self._apertures.add(moment.now_s, state.aperture_m)
        if sample is not None and sample.valid:
            self._detector.push(sample)
            self._touch.push(sample, empty=not any(self._brakes))
            self._was_touched |= max(sample.force_n) >= self._settings.contact_force_n
        self._brake(moment)
        touched = self._touched()
        # The goal runs ahead of the fingers by a little only: that is how far they would go on
        # if nobody wrote a new one.
        self._aperture_m = max(
            self._aperture_m - self._speed_m_s * moment.dt_s,
            state.aperture_m - LEAD_M,
        )
        paused_rad = self._paused_rad(moment.now_s, state)
        angles_rad = self._angles_rad(state, touched, paused_rad)
        still = abs(state.aperture_velocity_m_s) <= STALL_SPEED_M_S
        if still and not any(touched) and all(rad is None for rad in paused_rad):
            self._boost = min(LARGEST_BOOST, self._boost + BOOST_PER_S * moment.dt_s)
        else:
            self._boost = max(1.0, self._boost - 2.0 * BOOST_PER_S * moment.dt_s)
        self.event = self._found(moment.now_s, state, touched)
        if self.event in (ApproachEvent.LIMIT, ApproachEvent.OBSTRUCTED):
            angles_rad = state.angles_rad
        current_a = self._current_max_a if self._begins and self._travels else self.current_a
        goals = [ServoGoal(angle_rad=angle, current_a=current_a) for angle in angles_rad]
        if self.event is ApproachEvent.CLOSING:
            for finger, brake in enumerate(self._brakes):
                if brake is not None and not (touched[finger] and len(goals) > 1):
                    goals[finger] = self._slow_goal(moment, finger, brake)
        return Action(goals=goals, done=self.event is not ApproachEvent.CLOSING)

    def _new_speed_m_s(self, state: GripperState) -> float:
        return approach_speed_m_s(
            self._settings, self._linkage, state.angles_rad, travelling=self._travels
        )

    def _starts(self, moment: Moment) -> bool:
        """Return whether the fingers are still to get to their speed: the goal keeps its lead."""
        if self._started_s is None:
            self._started_s = moment.now_s
        nominal_rad_s = self._nominal_rad_s(moment.state)
        self._begins &= moment.now_s - self._started_s < _STARTING_S and any(
            -servo.velocity_rad_s < _RUNNING_SHARE * nominal_rad_s for servo in moment.state.servos
        )
        return self._begins

    def _slows_down(self, state: GripperState) -> bool:
        """Return whether the fingers that travelled are still to get to their new speed."""
        most_rad_s = self._nominal_rad_s(state) / _RUNNING_SHARE
        self._slows &= any(-servo.velocity_rad_s > most_rad_s for servo in state.servos)
        return self._slows

    def _lead_m(self, state: GripperState) -> float:
        """Return how far in m the goal is ahead of fingers that run at the nominal speed."""
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        nominal_rad_s = self._nominal_rad_s(state)
        return sum(
            self._linkage.opening_per_rad_m(angle_rad)
            * running_lead_rad(servo.servo_model, path.friction_nm / path.kt_nm_a, nominal_rad_s)
            for servo, path, angle_rad in zip(
                self._settings.servos, paths, state.angles_rad, strict=True
            )
        )

    def _touched(self) -> tuple[bool, bool]:
        """Return which fingers are in contact: what stopped a braked one need press half as hard.

        A contact makes the rest of the way, as slow as a finger creeps, needless.
        """
        first, second = self._detector.touched
        brakes = self._brakes if len(self._brakes) > 1 else self._brakes * 2
        sure = self._touch.means_n(self._settings.contact_samples)
        least_n = _SURE_SHARE * self._settings.contact_force_n
        return (
            first or (brakes[0] is not None and sure[0] >= least_n),
            second or (brakes[1] is not None and sure[1] >= least_n),
        )

    def _brake(self, moment: Moment) -> None:
        """Brake each finger whose pad shows a first touch; let those go on that touch nothing."""
        sample, state = moment.sample, moment.state
        if sample is None or not sample.valid:
            return
        shows, lasts = self._touch.shows, self._touch.lasts
        if len(state.servos) == 1:
            shows, lasts = (any(shows),) * 2, (any(lasts),) * 2
        for finger, servo in enumerate(state.servos):
            brake = self._brakes[finger]
            path = transmissions(self._settings, self._linkage, state.angles_rad)[finger]
            if brake is None:
                if -servo.velocity_rad_s >= _RUNNING_SHARE * self._nominal_rad_s(state):
                    share = min(1.0, moment.dt_s / _FREE_TIME_S)
                    self._free_a[finger] -= share * (servo.current_a + self._free_a[finger])
                young = moment.now_s - sample.measured_s <= _YOUNG_S
                if shows[finger] and young and not self._soft[finger]:
                    lead_m = state.aperture_m - self._aperture_m
                    self._brakes[finger] = _Brake(moment.now_s, servo.angle_rad, lead_m)
                    self.braked_s = moment.now_s
                continue
            soft = (brake.angle_rad - servo.angle_rad) * path.radius_m > _SOFT_M
            empty = moment.now_s - brake.since_s > _DOUBT_S and not lasts[finger]
            if soft or empty:
                self._brakes[finger] = None
                self._soft[finger] = soft
                if not soft:
                    self._touch.was_wrong()
                self._aperture_m = state.aperture_m - _LEAD_SHARE * brake.lead_m
            self._was_running[finger] &= self._brakes[finger] is None

    def _slow_goal(self, moment: Moment, finger: int, brake: "_Brake") -> ServoGoal:
        """Return the goal of a braked finger: at rest first, then pressing ever harder."""
        servo, settings = moment.state.servos[finger], self._settings
        if moment.now_s - brake.since_s < _BRAKED_S or -servo.velocity_rad_s > _CREEP_RAD_S:
            return ServoGoal(angle_rad=servo.angle_rad, current_a=self.current_a)
        path = transmissions(settings, self._linkage, moment.state.angles_rad)[finger]
        most_n = settings.contact_force_n + _CREEP_RESERVE_N
        rate_n_s = _CREEP_N_S if brake.drive_n < most_n else _LATE_CREEP_N_S
        brake.drive_n += rate_n_s * moment.dt_s
        current_a = min(
            self._free_a[finger] + brake.drive_n * path.radius_m / path.kt_nm_a,
            LARGEST_BOOST * self._closing_a,
            self._current_max_a,
        )
        margin_rad = closing_margin_rad(settings.servos[finger].servo_model, current_a)
        return ServoGoal(angle_rad=servo.angle_rad - margin_rad, current_a=current_a)

    def _nominal_rad_s(self, state: GripperState) -> float:
        reach_m = sum(self._linkage.opening_per_rad_m(servo.angle_rad) for servo in state.servos)
        return self._speed_m_s / reach_m

    def _angles_rad(
        self,
        state: GripperState,
        touched: tuple[bool, bool],
        paused_rad: Sequence[float | None],
    ) -> Sequence[float]:
        """Return the goal angles: where a finger touched, where it pauses, or farther closed."""
        angles_rad = list(self._linkage.angles_rad(self._aperture_m))
        for finger, servo in enumerate(state.servos):
            if len(angles_rad) == 1 or not touched[finger]:
                self._waiting_rad[finger] = None
            elif self._waiting_rad[finger] is None:
                self._waiting_rad[finger] = servo.angle_rad
            still_rad = self._waiting_rad[finger]
            if still_rad is None:
                still_rad = paused_rad[finger]
            if still_rad is not None:
                angles_rad[finger] = still_rad
        return angles_rad

    def _paused_rad(self, now_s: float, state: GripperState) -> list[float | None]:
        """Return where a finger waits that has just been slowed down, None while it closes.

        A part slows a finger down tens of milliseconds before the pads report it. Where they
        report none, the finger goes on, from rest.
        """
        nominal_rad_s = self._nominal_rad_s(state)
        for finger, servo in enumerate(state.servos):
            closing_rad_s = -servo.velocity_rad_s
            pause = self._pauses[finger]
            if pause is not None and now_s >= pause[1]:
                self._pauses[finger] = None
                self._aperture_m = state.aperture_m
            elif pause is None and closing_rad_s >= _RUNNING_SHARE * nominal_rad_s:
                self._was_running[finger] = True
            elif (
                pause is None
                and self._was_running[finger]
                and nominal_rad_s >= _SLOWEST_RAD_S
                and closing_rad_s < _SLOWED_SHARE * nominal_rad_s
            ):
                self._was_running[finger] = False
                self._pauses[finger] = (servo.angle_rad, now_s + _PAUSE_S)
        return [None if pause is None else pause[0] for pause in self._pauses]

    def _found(
        self, now_s: float, state: GripperState, touched: tuple[bool, bool]
    ) -> ApproachEvent:
        if state.aperture_m <= self._settings.aperture_min_m:
            return ApproachEvent.LIMIT
        if all(touched):
            return ApproachEvent.CONTACT
        loaded = max(abs(s.current_a) for s in state.servos) >= (
            _STALL_CURRENT_SHARE * self.current_a
        )
        if not loaded or abs(state.aperture_velocity_m_s) > STALL_SPEED_M_S:
            self._moving_s = now_s
        if now_s - self._moving_s >= _STALL_TIME_S:
            return ApproachEvent.CONTACT if any(touched) else ApproachEvent.OBSTRUCTED
        if now_s >= self._deadline_s:
            return ApproachEvent.LIMIT
        return ApproachEvent.CLOSING


@dataclass(slots=True)
class _Brake:
    """Braked finger: since when, where, how far its goal was ahead, and its drive in N."""

    since_s: float
    angle_rad: float
    lead_m: float
    drive_n: float = _CREEP_START_N


class FirstTouch:
    """Detector of the first force on a pad, as soon as it stands out of what the empty pad shows.

    It may be wrong now and then: what it starts goes on without it.
    """

    def __init__(self) -> None:
        self._factor = 1.0
        self._empty_n2: list[float] = []
        self._recent: deque[ForceSample] = deque(maxlen=_TOUCH_SAMPLES)

    @property
    def shows(self) -> tuple[bool, bool]:
        """Whether the newest samples show a touch of finger 0 and of finger 1."""
        return self._stands_out(0), self._stands_out(1)

    @property
    def lasts(self) -> tuple[bool, bool]:
        """Whether the mean of the last samples still shows a touch of finger 0 and of finger 1."""
        sums_n = [sum(sample.force_n[finger] for sample in self._recent) for finger in (0, 1)]
        least_n = _TOUCH_N * len(self._recent)
        return sums_n[0] > least_n, sums_n[1] > least_n

    def means_n(self, samples: int) -> tuple[float, float]:
        """Return the mean force in N on finger 0 and finger 1 in so many of the newest samples.

        0 where there are fewer.
        """
        newest = list(self._recent)[-min(samples, _TOUCH_SAMPLES) :]
        if len(newest) < min(samples, _TOUCH_SAMPLES):
            return 0.0, 0.0
        n = len(newest)
        return sum(s.force_n[0] for s in newest) / n, sum(s.force_n[1] for s in newest) / n

    def was_wrong(self) -> None:
        """Show a touch only at a larger force from now on: the last one was none."""
        self._factor *= _WRONG_FACTOR

    def push(self, sample: ForceSample, *, empty: bool) -> None:
        """Add a sample, which may be the same as before; ``empty`` where no finger is braked."""
        if self._recent and sample.t_s <= self._recent[-1].t_s:
            return
        if not self._empty_n2:
            self._empty_n2 = [2.0 * sample.noise_n**2] * 2
        elif empty and len(self._recent) == _TOUCH_SAMPLES:
            for finger, force_n in enumerate(self._recent[0].force_n):
                self._empty_n2[finger] += (force_n**2 - self._empty_n2[finger]) / _EMPTY_SAMPLES
        self._recent.append(sample)

    def _stands_out(self, finger: int) -> bool:
        sum_n = 0.0
        for n, sample in enumerate(reversed(self._recent), 1):
            sum_n += sample.force_n[finger]
            noise_n = sqrt(self._empty_n2[finger] / n)
            if sum_n > n * self._factor * max(_TOUCH_N, _TOUCH_SIGMAS * noise_n):
                return True
        return False


class ContactDetector:
    """Detector of a contact: enough new samples in a row above a threshold, for each finger.

    Of a fast sensor each counts with those shortly before it, whose mean has less noise.

    Parameters
    ----------
    threshold_n
        Force on a pad in N that counts.
    samples
        New samples in a row that confirm.
    """

    def __init__(self, threshold_n: float, samples: int) -> None:
        self._threshold_n = threshold_n
        self._samples = samples
        self._counts = [0, 0]
        self._first_s = [0.0, 0.0]
        self._recent = RecentForce(_CONTACT_QUIET_N, least=1, longest_s=_CONTACT_LONGEST_S)

    @property
    def touched(self) -> tuple[bool, bool]:
        """Contact of finger 0 and finger 1."""
        return self._counts[0] >= self._samples, self._counts[1] >= self._samples

    @property
    def first_s(self) -> float:
        """Time in s at which the finger that touched last was loaded."""
        return max(self._first_s)

    def push(self, sample: ForceSample) -> None:
        """Add a sample, which may be the same as before."""
        if self._recent.push(sample) is None:
            return
        for finger, force_n in enumerate(self._recent.finger_means_n):
            above = force_n >= self._threshold_n
            if self._counts[finger] == 0:
                self._first_s[finger] = self._recent.oldest.measured_s
            self._counts[finger] = self._counts[finger] + 1 if above else 0


class ContactRest:
    """Rest of the fingers on the part, and the force that the pads measure in it.

    Parameters
    ----------
    until_s
        Monotonic time in s at which the rest ends, or before where the force is known.
    hard_n, hard_until_s
        Force in N from which on a part was met hard, and when the rest ends then at the earliest.
    """

    def __init__(self, until_s: float, *, hard_n: float, hard_until_s: float) -> None:
        self._until_s = until_s
        self._hard_n, self._hard_until_s = hard_n, hard_until_s
        self._begun_s: float | None = None
        self._settled = False
        self._samples = RecentForce(_REST_QUIET_N, least=_REST_SAMPLES, longest_s=_REST_LONGEST_S)

    @property
    def force_n(self) -> float:
        """Mean grip force in N of the last samples, at least 0; 0 without any."""
        return max(0.0, self._samples.grip_n) if self._samples else 0.0

    def goes_on(self, moment: Moment) -> bool:
        """Add the newest sample and return whether the fingers still rest."""
        if self._begun_s is None:
            self._begun_s = moment.now_s
        sample = moment.sample
        if sample is not None and sample.valid:
            if not self._settled:
                self._samples.clear()
                self._settled = sample.measured_s >= self._begun_s + _REST_SETTLING_S
            self._samples.push(sample)
        young = sample is not None and moment.now_s - sample.measured_s <= _YOUNG_S
        known = self._settled and (
            self._samples.noise_n <= (_REST_QUIET_YOUNG_N if young else _REST_QUIET_N)
        )
        hard = self.force_n >= self._hard_n and moment.now_s < self._hard_until_s
        return moment.now_s < self._until_s and (hard or not known)
