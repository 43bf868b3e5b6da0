"""Closing of both fingers until the pads show a contact, and its force at rest."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from math import inf, sqrt

from gripper.force.certainty import BRIEF_S, PRESENT_SHARE, REACHED_SHARE, STALLED_S
from gripper.force.estimates.grip import StiffnessEstimate
from gripper.force.loop import Action, Moment
from gripper.mechanics.impact import approach_speed_m_s, closing_current_max_a, slowing_way_m
from gripper.mechanics.transmission import BOOST_PER_S, MOST_FRICTION, Mechanics, Transmission
from gripper.servos.goal_limits import (
    ServoGoal,
    closing_margin_rad,
    most_closed_rad,
    running_lead_rad,
)
from gripper.servos.motion import slow_rad_s
from gripper.settings import ServoSettings
from gripper.values.force_sensor import QUIET_N, ForceSample, RecentForce, mean_n
from gripper.values.state import STANDING_M_S, ServoFeedback, ServoState

_TOUCH_N = 0.12
"""Least force in N on a pad that shows a first touch, also on a quiet pad. [tuned]"""
_TOUCH_SIGMAS = 3.5
"""Standard deviations of the empty pad's noise by which a first touch exceeds it: a false one
stops its finger for a moment. [statistics]"""
_EMPTY_SAMPLES = 20
"""Number of samples for the noise of an empty pad. [tuned]"""
_TOUCH_SAMPLES = 8
"""Most newest samples whose mean is compared with it; older ones are of the empty pad. [tuned]"""
_REST_S, _HARD_S = 0.08, 0.065
"""Rest of the fingers at the contact, so that the ramp begins at the force there. Its longest time
in s, and its least after a hard touch. [tuned]"""
_BRAKED_S = 0.01
"""Time in s for which a braked finger stops, and before samples of the rest count. [chosen]"""


class FirstTouch:
    """Detector of the first force on a pad above the noise of the empty pad.

    It may be wrong sometimes: the approach then continues.
    """

    def __init__(self) -> None:
        self._empty_n2: list[float] = []
        self._recent: deque[ForceSample] = deque(maxlen=_TOUCH_SAMPLES)

    @property
    def shows(self) -> tuple[bool, bool]:
        """Whether the newest samples show a touch of finger 0 and of finger 1."""
        return self._stands_out(0), self._stands_out(1)

    @property
    def lasts(self) -> tuple[bool, bool]:
        """Whether the mean of the last samples still shows a touch of finger 0 and of finger 1."""
        first_n, second_n = self.means_n(max(1, len(self._recent)))
        return first_n > _TOUCH_N, second_n > _TOUCH_N

    def means_n(self, samples: int) -> tuple[float, float]:
        """Return the mean force in N on finger 0 and finger 1 in so many of the newest samples.

        0 where there are fewer.
        """
        n = min(samples, _TOUCH_SAMPLES)
        newest = list(self._recent)[-n:]
        return mean_n([sample.force_n for sample in newest]) if len(newest) == n else (0.0, 0.0)

    def push(self, sample: ForceSample, *, empty: bool) -> None:
        """Add a sample, which may be the same as before; ``empty``: no finger is braked."""
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
            if sum_n > n * max(_TOUCH_N, _TOUCH_SIGMAS * noise_n):
                return True
        return False


class ContactDetector:
    """Detector of a contact: enough new samples in a row above a threshold, for each finger.

    With a fast sensor the mean of a sample and those shortly before it counts, to reduce the noise.

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
        self._recent = RecentForce(one_frame=True)

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
    """Rest of the fingers on the part, until the pads have measured its force.

    Parameters
    ----------
    begun_s
        Monotonic time in s of the contact.
    hard_n
        Least force in N of a hard touch.
    """

    def __init__(self, begun_s: float, *, hard_n: float) -> None:
        self._begun_s, self._hard_n = begun_s, hard_n
        self._samples = RecentForce()

    @property
    def force_n(self) -> float:
        """Mean grip force in N of the last samples, at least 0; 0 without any."""
        return max(0.0, self._samples.grip_n) if self._samples else 0.0

    def goes_on(self, moment: Moment) -> bool:
        """Add the newest sample and return whether the fingers still rest."""
        sample, settled_s = moment.sample, self._begun_s + _BRAKED_S
        if sample is not None and sample.valid:
            if self._samples and self._samples.oldest.measured_s < settled_s <= sample.measured_s:
                self._samples.clear()
            self._samples.push(sample)
        known = (
            self._samples
            and self._samples.oldest.measured_s >= settled_s
            and self._samples.noise_n <= QUIET_N
        )
        rested_s = moment.now_s - self._begun_s
        fresh = self.force_n >= self._hard_n and rested_s < _HARD_S
        return rested_s < _REST_S and (fresh or not known)


_LEAD_M = 0.006
"""Lead of the goal before the fingers in m: their motion if no further goal is written. [chosen]"""
_CREEP_N, _CREEP_N_S = 0.2, 20.0
"""First drive in N of a braked finger, less than the force of the pad, and its growth in N/s.
[tuned]"""


class ApproachEvent(Enum):
    """Result of a step of an approach: still closing, or the end of the approach."""

    CLOSING = "closing"
    CONTACT = "contact"
    LIMIT = "limit"
    OBSTRUCTED = "obstructed"


@dataclass(slots=True)
class _Finger:
    """One finger: its brake, where it waits after its touch, and its currents where it is now."""

    servo: ServoSettings
    """Its servo."""
    least_rad: float
    """Its most closed goal in rad."""
    braked_s: float | None = None
    drive_n: float = _CREEP_N
    waits_rad: float | None = None
    boost: float = 1.0
    """Factor on its current."""
    path: Transmission = field(init=False)
    closing_a: float = field(init=False)
    most_a: float = field(init=False)
    reach_m: float = field(init=False)
    """Its transmission, its current without the factor, the largest one, and the opening in m by
    one rad."""

    @property
    def current_a(self) -> float:
        """Its goal current in A."""
        return min(self.closing_a * self.boost, self.most_a)


class Approach:
    """Step of control that closes both fingers evenly; a finger that touches waits for the other.

    The fingers travel fast at openings wider than all earlier parts, and slow down in time. The
    pads decide. A finger with a recent first touch brakes to rest and then presses with growing
    force until the contact is sure; after a false touch it runs on. When the fingers stand still at
    the current limit, one pad is enough (the other may be touched beside its taxels); without any
    pad the fingers are obstructed. The current grows by up to 60 % while the fingers stand still
    untouched, because friction at rest differs between servos.

    Parameters
    ----------
    mechanics
        Of the gripper, or that with which empty fingers meet.
    state
        Feedback at the start.
    widest_m
        Opening in m above which no part begins; None if not known.
    may_boost
        Whether the current may grow while the fingers stand untouched.
    """

    def __init__(
        self,
        mechanics: Mechanics,
        state: ServoFeedback,
        *,
        widest_m: float | None = None,
        may_boost: bool = True,
    ) -> None:
        self.event = ApproachEvent.CLOSING
        """Result of the last step."""
        self.state = state
        """Its feedback."""
        self.stiffness = StiffnessEstimate(mechanics)
        """Stiffness of the part so far."""
        self.mechanics, self.settings = mechanics, mechanics.settings
        settings, self._linkage = self.settings, mechanics.linkage
        self._slow_at_m = inf
        if widest_m is not None:
            self._slow_at_m = widest_m + slowing_way_m(mechanics, state.angles_rad, widest_m)
        self._travels = state.aperture_m > self._slow_at_m
        self._may_boost = may_boost
        self._changed_s, self._changes = state.t_s, True
        self._aperture_m = state.aperture_m
        self._detector = ContactDetector(settings.contact_force_n, settings.contact_samples)
        self._touch, self._was_touched = FirstTouch(), False
        self._fingers = list(map(_Finger, settings.servos, most_closed_rad(mechanics)))
        self._deadline_s = state.t_s + settings.contact_timeout_s
        self._moving_s = state.t_s
        self._look(state)

    def _look(self, state: ServoFeedback) -> None:
        """Set transmissions, currents, speed and lead by the present position and friction."""
        mechanics, settings, linkage = self.mechanics, self.settings, self._linkage
        paths = mechanics.transmissions(state.angles_rad)
        needed_a = mechanics.motion_currents_a(paths, settings.approach_force_n)
        for index, finger in enumerate(self._fingers):
            finger.path = paths[index]
            finger.most_a = closing_current_max_a(settings, finger.path)
            finger.closing_a = min(needed_a[index], finger.most_a)
            finger.reach_m = linkage.opening_per_rad_m(state.angles_rad[index])
        self._speed_m_s = approach_speed_m_s(mechanics, state.angles_rad, travelling=self._travels)
        reach_m = sum(finger.reach_m for finger in self._fingers)
        self._nominal_rad_s = speed = self._speed_m_s / reach_m
        self._lead_m = 0.0
        for finger in self._fingers:
            model, moving_a = finger.servo.servo_model, finger.path.drive.moving_a(speed)
            self._lead_m += finger.reach_m * running_lead_rad(model, moving_a, speed)

    @property
    def currents_a(self) -> list[float]:
        """Goal current of each servo now in A."""
        return [finger.current_a for finger in self._fingers]

    @property
    def friction_advice(self) -> str:
        """Advice where a servo has the most current that the cap of the force allows, or empty."""
        for finger in self._fingers:
            if finger.current_a >= finger.most_a:
                return (
                    f"; or servo {finger.servo.servo_id} does not overcome its friction with "
                    f"{finger.most_a:.2f} A, the most that gripper.force_max_n = "
                    f"{self.settings.force_max_n:g} N allows: raise that, or lengthen the levers "
                    f"of the fingers"
                )
        return ""

    @property
    def pads_n(self) -> tuple[float, float]:
        """Mean force in N on each finger in the samples that decide on a contact; 0 with fewer."""
        return self._touch.means_n(self.settings.contact_samples)

    @property
    def touch_m(self) -> float:
        """Opening in m at which both pads were first loaded, by the samples of the contact.

        The present opening if a contact was found without them.
        """
        if not all(self._detector.touched):
            return self.state.aperture_m
        return self.stiffness.apertures.at(self._detector.first_s)

    def runs_freely(self, state: ServoFeedback) -> bool:
        """Return whether all fingers close steadily and no pad has been touched so far."""
        return not self._was_touched and all(
            self._nominal_rad_s + servo.velocity_rad_s
            <= max((1.0 - REACHED_SHARE) * self._nominal_rad_s, slow_rad_s(settings.servo_model))
            for servo, settings in zip(state.servos, self.settings.servos, strict=True)
        )

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period; an end leaves the fingers where they are or touch."""
        self.state = state = moment.state
        self.stiffness.push(moment)
        if moment.sample is not None and moment.sample.valid:
            self._take(moment, moment.sample)
        self._plan(moment)
        touched = self._touched()
        self._boost(moment, free=self._may_boost and not any(touched))
        self.event = self._result(moment.now_s, touched)
        angles_rad = self._linkage.angles_rad(self._aperture_m)
        goals = []
        for index, (finger, servo) in enumerate(zip(self._fingers, state.servos, strict=True)):
            waits = touched[index] and len(self._fingers) > 1
            since_rad = servo.angle_rad if finger.waits_rad is None else finger.waits_rad
            finger.waits_rad = since_rad if waits else None
            angle_rad = angles_rad[index]
            current_a = finger.most_a if self._changes and self._travels else finger.current_a
            if self.event in (ApproachEvent.LIMIT, ApproachEvent.OBSTRUCTED):
                angle_rad = servo.angle_rad
            elif finger.waits_rad is not None:
                angle_rad = finger.waits_rad
            elif finger.braked_s is not None and self.event is ApproachEvent.CLOSING:
                angle_rad, current_a = self._creeping(moment, finger, servo)
            # A lead in mm is a large angle of a small pinion.
            angle_rad = max(angle_rad, min(finger.least_rad, servo.angle_rad))
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=current_a))
        return Action(goals=goals, done=self.event is not ApproachEvent.CLOSING)

    def _take(self, moment: Moment, sample: ForceSample) -> None:
        """Use a valid sample: brake each finger with a first touch, or let it run on."""
        self._detector.push(sample)
        braked = any(finger.braked_s is not None for finger in self._fingers)
        self._touch.push(sample, empty=not braked)
        self._was_touched |= max(sample.force_n) >= self.settings.contact_force_n
        shows, lasts = self._touch.shows, self._touch.lasts
        if len(self._fingers) == 1:
            shows, lasts = (any(shows),) * 2, (any(lasts),) * 2
        for index, finger in enumerate(self._fingers):
            if finger.braked_s is None:
                if shows[index] and moment.young:
                    finger.braked_s = moment.now_s
            elif moment.now_s - finger.braked_s > BRIEF_S and not lasts[index]:
                finger.braked_s = None
                self._aperture_m = moment.state.aperture_m - self._lead_m

    def _plan(self, moment: Moment) -> None:
        """Advance the opening to which both fingers close: it leads them by a little only.

        While the fingers change their speed, the goal keeps its lead.
        """
        state, travelled = moment.state, self._travels
        self._travels &= state.aperture_m > self._slow_at_m and not self._was_touched
        self._look(state)
        if travelled and not self._travels:
            self._changed_s, self._changes = moment.now_s, True
        speeds_rad_s = [-servo.velocity_rad_s for servo in state.servos]
        fast = max(speeds_rad_s) > self._nominal_rad_s / REACHED_SHARE
        even = min(speeds_rad_s) >= self._nominal_rad_s * REACHED_SHARE and not fast
        self._changes &= moment.now_s - self._changed_s < BRIEF_S and not even
        # Fingers that break loose with more current would follow a goal far ahead too fast.
        if self._changes or (fast and max(finger.boost for finger in self._fingers) > 1.0):
            self._aperture_m = state.aperture_m - self._lead_m
        self._aperture_m = max(
            self._aperture_m - self._speed_m_s * moment.dt_s, state.aperture_m - self._most_lead_m()
        )

    def _most_lead_m(self) -> float:
        """Return the largest lead of the goal before the fingers in m.

        A small lead limits their motion if no further goal is written. Fingers that stand untouched
        get the lead that their current needs: a position controller with a small gain would not
        reach this current otherwise.
        """
        pressing_m = 0.0
        if max(finger.boost for finger in self._fingers) > 1.0:
            pressing_m = sum(
                finger.reach_m * closing_margin_rad(finger.servo.servo_model, finger.current_a)
                for finger in self._fingers
            )
        return max(_LEAD_M, self._lead_m, pressing_m)

    def _boost(self, moment: Moment, *, free: bool) -> None:
        """Let the current of each finger grow while it stands untouched; it falls twice as fast."""
        step = BOOST_PER_S * moment.dt_s
        for finger, servo in zip(self._fingers, moment.state.servos, strict=True):
            stands = abs(servo.velocity_rad_s) <= (1.0 - REACHED_SHARE) * self._nominal_rad_s
            if free and finger.braked_s is None and stands:
                finger.boost = min(finger.path.most_boost, finger.boost + step)
            elif finger.path.drive.measured:
                finger.boost = max(1.0, finger.boost - 2.0 * step)

    def _creeping(self, moment: Moment, finger: _Finger, servo: ServoState) -> tuple[float, float]:
        """Return goal angle and current of a braked finger: at rest, then with growing force."""
        model, path = finger.servo.servo_model, finger.path
        assert finger.braked_s is not None
        runs = -servo.velocity_rad_s > slow_rad_s(model)
        brakes = moment.now_s - finger.braked_s < _BRAKED_S
        if runs and brakes:
            # A finger that did not move since an earlier touch needs the drive from there on.
            finger.drive_n = _CREEP_N
        if runs or brakes:
            return servo.angle_rad, finger.current_a
        finger.drive_n += _CREEP_N_S * moment.dt_s
        current_a = min(
            path.drive.breakaway_a + finger.drive_n / path.n_per_a,
            MOST_FRICTION * finger.closing_a,
            finger.most_a,
        )
        return servo.angle_rad - closing_margin_rad(model, current_a), current_a

    def _touched(self) -> tuple[bool, ...]:
        """Return which pads are in contact: for a braked finger half the force is enough."""
        least_n = PRESENT_SHARE * self.settings.contact_force_n
        return tuple(
            touched or (finger.braked_s is not None and pad_n >= least_n)
            for touched, finger, pad_n in zip(
                self._detector.touched, (self._fingers * 2)[:2], self.pads_n, strict=True
            )
        )

    def _result(self, now_s: float, touched: Sequence[bool]) -> ApproachEvent:
        state = self.state
        if state.aperture_m <= self.settings.aperture_min_m:
            return ApproachEvent.LIMIT
        if all(touched):
            return ApproachEvent.CONTACT
        loaded = any(
            abs(servo.current_a) >= REACHED_SHARE * finger.current_a
            for servo, finger in zip(state.servos, self._fingers, strict=True)
        )
        # Fingers of unknown friction get time to break away.
        loaded &= all(
            finger.path.drive.measured
            or finger.boost >= finger.path.drive.most_breakaway_a / finger.path.drive.breakaway_a
            or finger.current_a >= finger.most_a
            for finger in self._fingers
        )
        if not loaded or abs(state.aperture_velocity_m_s) > STANDING_M_S:
            self._moving_s = now_s
        if now_s - self._moving_s >= STALLED_S:
            pressed = any(touched) or all(self._touch.lasts)
            return ApproachEvent.CONTACT if pressed else ApproachEvent.OBSTRUCTED
        return ApproachEvent.LIMIT if now_s >= self._deadline_s else ApproachEvent.CLOSING
