"""Closing of both fingers until the pads are touched."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.force.approach.contact import LOADED_SHARE, ContactDetector, FirstTouch
from gripper.force.estimates.history import History
from gripper.force.estimates.stiffness import StiffnessEstimate
from gripper.force.loop import Action, Moment
from gripper.mechanics.impact import approach_speed_m_s, closing_current_max_a, slowing_way_m
from gripper.mechanics.kinematics import (
    MOST_FRICTION,
    Linkage,
    Transmission,
    motion_currents_a,
    transmissions,
)
from gripper.servos.goal_limits import (
    ServoGoal,
    closing_margin_rad,
    most_closed_rad,
    running_lead_rad,
)
from gripper.servos.motion import slow_rad_s
from gripper.settings import GripperSettings
from gripper.values.state import STANDING_M_S, ServoFeedback

_STALL_CURRENT_SHARE = 0.8
"""Share of the goal current at which a servo at rest pushes against something. [tuned]"""
_STANDING_SHARE = 0.2
"""Share of the nominal speed below which a finger stands, held by friction. [chosen]"""
_STALL_TIME_S = 0.5
"""Time in s for which both must last before the fingers are stalled. [chosen]"""
LEAD_M = 0.006
"""Lead of the goal before the fingers in m: their motion if no further goal is written. [chosen]"""
_HELD_SHARE = 0.8
"""Share of the least friction at rest that moves no finger. [chosen]"""
_LEAD_RESERVE = 1.3
"""Lead relative to that for friction and speed. [chosen]"""
_STARTING_S = 0.1
"""Longest time in s until the fingers reach their speed; with more friction than in the model the
goal then runs on. [chosen]"""
_RUNNING_SHARE = 0.8
"""Share of the nominal speed above which a finger runs, and the inverse of the fastest one.
[tuned]"""
_SLOWED_SHARE = 0.6
"""Share of the nominal speed below which something has slowed down a running finger. [tuned]"""
_SLOWEST_COUNTS = 4.0
"""Nominal speed in those of a servo at rest below which a slowed finger does not stand out.
[resolution]"""
_PAUSE_S = 0.15
"""Time in s for which a slowed finger waits for the pads: their delay and three samples. [tuned]"""
BOOST_PER_S = 2.0
"""Growth in 1/s of the factor on the current of fingers that stand still untouched; it falls twice
as fast. At most it is `MOST_FRICTION`. [tuned]"""
_BRAKED_S = 0.01
"""Time in s for which a braked finger stops before it continues slowly. [chosen]"""
_DOUBT_S = 0.05
"""Time in s after which a braked finger without force on its pad runs on. [chosen]"""
_CREEP_N_S, _LATE_CREEP_N_S = 20.0, 4.0
"""Rate in N/s at which the drive of a braked finger grows: up to slightly more than the force of a
contact, and beyond. [tuned]"""
_CREEP_RESERVE_N = 0.2
"""This excess in N: friction at rest is larger than in motion. [tuned]"""
_SOFT_M = 0.0002
"""Travel in m of a braked finger after which it runs on: a part that yields so far without the
force of a contact is soft, and makes no large impact. [tuned]"""
_LEAD_SHARE = 0.75
"""Share of its lead with which the goal of a finger runs on, so that the finger does not overshoot.
[tuned]"""
_CREEP_START_N = 0.2
"""First drive in N of a braked finger: less than the force of the pad. [tuned]"""
_CREEP_COUNTS = 1.5
"""Speed in those of a servo at rest above which a braked finger has lost the part, and stops again.
[resolution]"""
_FREE_TIME_S = 0.05
"""Time constant in s of the current that moves an empty finger. [tuned]"""


class ApproachEvent(Enum):
    """Result of a step of an approach: still closing, or the end of the approach."""

    CLOSING = "closing"
    CONTACT = "contact"
    LIMIT = "limit"
    OBSTRUCTED = "obstructed"


class Approach:
    """Step of control that closes both fingers evenly; a finger that touches waits for the other.

    The fingers travel fast at openings wider than all earlier parts, and slow down in time. The
    pads decide. A finger with a recent first touch brakes to rest and then presses with growing
    force until the contact is sure; after a false touch, or on a soft part, it runs on. When the
    fingers stand still at the current limit, one pad is enough (the other may be touched beside its
    taxels); without any pad the fingers are obstructed. The current grows by up to 60 % while the
    fingers stand still untouched, because friction at rest differs between servos.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the start.
    widest_m
        Opening in m above which no part begins; None if not known.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: ServoFeedback,
        *,
        widest_m: float | None = None,
    ) -> None:
        self.event = ApproachEvent.CLOSING
        """Result of the last step."""
        self.braked_s = state.t_s
        """Monotonic time in s of the newest first touch that braked a finger; that of the start
        before one."""
        self._settings = settings
        self._linkage = linkage
        self._least_rad = most_closed_rad(settings, linkage)
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
        self._paths = self._limit(state)
        self._boosts = [1.0] * len(state.servos)
        self._detector = ContactDetector(settings.contact_force_n, settings.contact_samples)
        self._aperture_m = state.aperture_m
        self._begins, self._slows = True, False
        self._started_s: float | None = None
        self._apertures = History()
        self._was_touched = False
        self._touch = FirstTouch()
        self._free_a = [path.drive.breakaway_a for path in self._paths]
        self._brakes: list[_Brake | None] = [None] * len(state.servos)
        self._soft = [False] * len(state.servos)
        self._waiting_rad: list[float | None] = [None] * len(state.servos)
        self._was_running = [False] * len(state.servos)
        self._pauses: list[tuple[float, float] | None] = [None] * len(state.servos)
        self._deadline_s = state.t_s + settings.contact_timeout_s
        self._moving_s = state.t_s

    def _limit(self, state: ServoFeedback) -> tuple[Transmission, ...]:
        """Set the needed and largest current of each servo by its present characteristic."""
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        self._most_a = [closing_current_max_a(self._settings, path, stood_a=inf) for path in paths]
        needed_a = motion_currents_a(self._settings, paths, self._settings.approach_force_n)
        self._closing_a = list(map(min, needed_a, self._most_a))
        return paths

    @property
    def currents_a(self) -> list[float]:
        """Goal current of each servo now in A."""
        return [
            min(closing_a * boost, most_a)
            for closing_a, boost, most_a in zip(
                self._closing_a, self._boosts, self._most_a, strict=True
            )
        ]

    @property
    def touch_m(self) -> float:
        """Opening in m at which both pads were first loaded, by the samples of the contact.

        The present opening if a contact was found without them.
        """
        if not all(self._detector.touched):
            return self._apertures.newest
        return self._apertures.at(self._detector.first_s)

    def runs_freely(self, state: ServoFeedback) -> bool:
        """Return whether all fingers close steadily and no pad has been touched so far."""
        nominal_rad_s = self._nominal_rad_s(state)
        return not self._was_touched and all(
            nominal_rad_s + servo.velocity_rad_s
            <= max((1.0 - _RUNNING_SHARE) * nominal_rad_s, slow_rad_s(settings.servo_model))
            for servo, settings in zip(state.servos, self._settings.servos, strict=True)
        )

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period; an end leaves the fingers where they are or touch."""
        state, sample = moment.state, moment.sample
        if any(
            path.drive is not drive for path, drive in zip(self._paths, self._drives(), strict=True)
        ):
            self._paths = self._limit(state)
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
        self._aperture_m = max(
            self._aperture_m - self._speed_m_s * moment.dt_s,
            state.aperture_m - self._most_lead_m(state),
        )
        paused_rad = self._paused_rad(moment.now_s, state)
        angles_rad = self._angles_rad(state, touched, paused_rad)
        may_boost = not any(touched) and all(rad is None for rad in paused_rad)
        still_rad_s = _STANDING_SHARE * self._nominal_rad_s(state)
        for finger, (servo, path) in enumerate(zip(state.servos, self._paths, strict=True)):
            boost, drive = self._boosts[finger], path.drive
            free = may_boost and self._brakes[finger] is None
            if free and abs(servo.velocity_rad_s) <= still_rad_s:
                most = max(MOST_FRICTION, drive.most_breakaway_a / drive.breakaway_a)
                boost = min(most, boost + BOOST_PER_S * moment.dt_s)
            elif drive.measured:
                boost = max(1.0, boost - 2.0 * BOOST_PER_S * moment.dt_s)
            self._boosts[finger] = boost
        self.event = self._found(moment.now_s, state, touched)
        if self.event in (ApproachEvent.LIMIT, ApproachEvent.OBSTRUCTED):
            angles_rad = state.angles_rad
        currents_a = self._most_a if self._begins and self._travels else self.currents_a
        goals = [
            ServoGoal(angle_rad=angle_rad, current_a=current_a)
            for angle_rad, current_a in zip(angles_rad, currents_a, strict=True)
        ]
        if self.event is ApproachEvent.CLOSING:
            for finger, brake in enumerate(self._brakes):
                if brake is not None and not (touched[finger] and len(goals) > 1):
                    goals[finger] = self._slow_goal(moment, finger, brake)
        # A lead in mm is a large angle of a small pinion.
        goals = [
            replace(goal, angle_rad=max(goal.angle_rad, min(least_rad, servo.angle_rad)))
            for goal, least_rad, servo in zip(goals, self._least_rad, state.servos, strict=True)
        ]
        return Action(goals=goals, done=self.event is not ApproachEvent.CLOSING)

    def _new_speed_m_s(self, state: ServoFeedback) -> float:
        return approach_speed_m_s(
            self._settings, self._linkage, state.angles_rad, travelling=self._travels
        )

    def _starts(self, moment: Moment) -> bool:
        """Return whether the fingers have not yet reached their speed: the goal keeps its lead."""
        if self._started_s is None:
            self._started_s = moment.now_s
        nominal_rad_s = self._nominal_rad_s(moment.state)
        self._begins &= moment.now_s - self._started_s < _STARTING_S and any(
            -servo.velocity_rad_s < _RUNNING_SHARE * nominal_rad_s for servo in moment.state.servos
        )
        return self._begins

    def _slows_down(self, state: ServoFeedback) -> bool:
        """Return whether fast fingers have not yet reached their new speed."""
        most_rad_s = self._nominal_rad_s(state) / _RUNNING_SHARE
        self._slows &= any(-servo.velocity_rad_s > most_rad_s for servo in state.servos)
        return self._slows

    def _lead_m(self, state: ServoFeedback) -> float:
        """Return the lead of the goal in m at the nominal speed."""
        return sum(
            self._linkage.opening_per_rad_m(angle_rad) * lead_rad
            for lead_rad, angle_rad in zip(self._leads_rad(state), state.angles_rad, strict=True)
        )

    def _resting_lead_m(self, state: ServoFeedback) -> float:
        """Return the largest lead of the goal in m before fingers held by friction."""
        return sum(
            self._linkage.opening_per_rad_m(now.angle_rad)
            * running_lead_rad(servo.servo_model, _HELD_SHARE * drive.least_breakaway_a, 0.0)
            for servo, drive, now in zip(
                self._settings.servos, self._drives(), state.servos, strict=True
            )
        )

    def _leads_rad(self, state: ServoFeedback) -> list[float]:
        """Return the lead of each finger's goal in rad at the nominal speed."""
        nominal_rad_s = self._nominal_rad_s(state)
        return [
            running_lead_rad(servo.servo_model, drive.moving_a(nominal_rad_s), nominal_rad_s)
            for servo, drive in zip(self._settings.servos, self._drives(), strict=True)
        ]

    def _drives(self) -> list[DriveCharacteristic]:
        return [
            self._settings.drives.of(servo.servo_id, servo.drive) for servo in self._settings.servos
        ]

    def _most_lead_m(self, state: ServoFeedback) -> float:
        """Return the largest lead of the goal before the fingers in m.

        A small lead limits their motion if no further goal is written. Fingers that stand untouched
        get the lead that their current needs: a position controller with a small gain would not
        reach this current otherwise.
        """
        running_m = _LEAD_RESERVE * self._lead_m(state)
        if max(self._boosts) <= 1.0:
            return max(LEAD_M, running_m)
        pressing_m = sum(
            self._linkage.opening_per_rad_m(now.angle_rad)
            * closing_margin_rad(servo.servo_model, closing_a * max(1.0, boost / MOST_FRICTION))
            for servo, now, closing_a, boost in zip(
                self._settings.servos, state.servos, self._closing_a, self._boosts, strict=True
            )
        )
        return max(LEAD_M, running_m, pressing_m)

    def _touched(self) -> tuple[bool, bool]:
        """Return which fingers are in contact: for a braked finger half the force is enough.

        The slow creep of a braked finger is then not needed.
        """
        first, second = self._detector.touched
        brakes = self._brakes if len(self._brakes) > 1 else self._brakes * 2
        sure = self._touch.means_n(self._settings.contact_samples)
        least_n = LOADED_SHARE * self._settings.contact_force_n
        return (
            first or (brakes[0] is not None and sure[0] >= least_n),
            second or (brakes[1] is not None and sure[1] >= least_n),
        )

    def _brake(self, moment: Moment) -> None:
        """Brake each finger whose pad shows a first touch; release the others."""
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
                if shows[finger] and moment.young and not self._soft[finger]:
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
        """Return the goal of a braked finger: first at rest, then with growing force."""
        servo, settings = moment.state.servos[finger], self._settings
        model = settings.servos[finger].servo_model
        creeps_rad_s = _CREEP_COUNTS * slow_rad_s(model)
        if moment.now_s - brake.since_s < _BRAKED_S or -servo.velocity_rad_s > creeps_rad_s:
            return ServoGoal(angle_rad=servo.angle_rad, current_a=self.currents_a[finger])
        path = transmissions(settings, self._linkage, moment.state.angles_rad)[finger]
        most_n = settings.contact_force_n + _CREEP_RESERVE_N
        rate_n_s = _CREEP_N_S if brake.drive_n < most_n else _LATE_CREEP_N_S
        brake.drive_n += rate_n_s * moment.dt_s
        current_a = min(
            # A finger that slowed down has shown less current than its friction, even below 0 A.
            max(0.0, self._free_a[finger]) + brake.drive_n / path.n_per_a,
            MOST_FRICTION * self._closing_a[finger],
            self._most_a[finger],
        )
        margin_rad = closing_margin_rad(model, current_a)
        return ServoGoal(angle_rad=servo.angle_rad - margin_rad, current_a=current_a)

    def _nominal_rad_s(self, state: ServoFeedback) -> float:
        reach_m = sum(self._linkage.opening_per_rad_m(servo.angle_rad) for servo in state.servos)
        return self._speed_m_s / reach_m

    def _angles_rad(
        self,
        state: ServoFeedback,
        touched: tuple[bool, bool],
        paused_rad: Sequence[float | None],
    ) -> Sequence[float]:
        """Return the goal angles: where a finger touched, where it pauses, or farther closed."""
        leads_rad = self._leads_rad(state)
        mean_rad = sum(leads_rad) / len(leads_rad)
        # A finger with more friction needs a goal that is farther ahead.
        angles_rad = [
            angle_rad - lead_rad + mean_rad
            for angle_rad, lead_rad in zip(
                self._linkage.angles_rad(self._aperture_m), leads_rad, strict=True
            )
        ]
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

    def _paused_rad(self, now_s: float, state: ServoFeedback) -> list[float | None]:
        """Return where a finger waits that has just been slowed down, None while it closes.

        A part slows a finger down tens of milliseconds before the pads report it. Where they
        report none, the finger goes on, from rest.
        """
        nominal_rad_s = self._nominal_rad_s(state)
        for finger, servo in enumerate(state.servos):
            unit_rad_s = slow_rad_s(self._settings.servos[finger].servo_model)
            closing_rad_s = -servo.velocity_rad_s
            pause = self._pauses[finger]
            if pause is not None and now_s >= pause[1]:
                self._pauses[finger] = None
                self._aperture_m = state.aperture_m - self._resting_lead_m(state)
            elif pause is None and closing_rad_s >= _RUNNING_SHARE * nominal_rad_s:
                self._was_running[finger] = True
            elif (
                pause is None
                and self._was_running[finger]
                and nominal_rad_s >= _SLOWEST_COUNTS * unit_rad_s
                and closing_rad_s < _SLOWED_SHARE * nominal_rad_s
            ):
                self._was_running[finger] = False
                self._pauses[finger] = (servo.angle_rad, now_s + _PAUSE_S)
        return [None if pause is None else pause[0] for pause in self._pauses]

    def _found(
        self, now_s: float, state: ServoFeedback, touched: tuple[bool, bool]
    ) -> ApproachEvent:
        if state.aperture_m <= self._settings.aperture_min_m:
            return ApproachEvent.LIMIT
        if all(touched):
            return ApproachEvent.CONTACT
        loaded = any(
            abs(servo.current_a) >= _STALL_CURRENT_SHARE * current_a
            for servo, current_a in zip(state.servos, self.currents_a, strict=True)
        )
        # Fingers of unknown friction get time to break away.
        loaded &= all(
            boost >= path.drive.most_breakaway_a / path.drive.breakaway_a or current_a >= most_a
            for boost, path, current_a, most_a in zip(
                self._boosts, self._paths, self.currents_a, self._most_a, strict=True
            )
            if not path.drive.measured
        )
        if not loaded or abs(state.aperture_velocity_m_s) > STANDING_M_S:
            self._moving_s = now_s
        if now_s - self._moving_s >= _STALL_TIME_S:
            return ApproachEvent.CONTACT if any(touched) else ApproachEvent.OBSTRUCTED
        if now_s >= self._deadline_s:
            return ApproachEvent.LIMIT
        return ApproachEvent.CLOSING


@dataclass(frozen=True, slots=True, kw_only=True)
class Reached:
    """End of an approach, and what it has shown of the part."""

    settings: GripperSettings
    """Those of the gripper, or those with which empty fingers meet."""
    event: ApproachEvent
    state: ServoFeedback
    """What has ended it, and the feedback then."""
    braked_s: float
    """Monotonic time in s at which a finger was braked at its first touch."""
    touch_m: float
    """Opening in m at which both pads were first loaded."""
    stiffness: StiffnessEstimate
    """Stiffness of the part so far."""


@dataclass(slots=True)
class _Brake:
    """Braked finger: since when, where, how far its goal was ahead, and its drive in N."""

    since_s: float
    angle_rad: float
    lead_m: float
    drive_n: float = _CREEP_START_N
