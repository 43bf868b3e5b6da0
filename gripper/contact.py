"""Approach: closing at a steady speed until both pads confirm the contact."""

from collections import deque
from collections.abc import Sequence
from enum import Enum

from gripper.force import ForceSample
from gripper.kinematics import Linkage
from gripper.registers import RAD_S_PER_VELOCITY_UNIT
from gripper.runner import Moment
from gripper.settings import GripperSettings
from gripper.state import GripperState

_STALL_SPEED_M_S = 0.002
_STALL_CURRENT_SHARE = 0.8
_STALL_TIME_S = 0.5
_LEAD_M = 0.006
_RUNNING_SHARE = 0.8
_SLOWED_SHARE = 0.6
_SLOWEST_RAD_S = 4.0 * RAD_S_PER_VELOCITY_UNIT
_PAUSE_S = 0.15
_LARGEST_BOOST = 1.6
_BOOST_PER_S = 2.0
_REST_SAMPLES = 4


class ContactDetector:
    """Says for each finger whether enough new samples in a row show a contact.

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
        self._last_s: float | None = None

    @property
    def touched(self) -> tuple[bool, bool]:
        """Contact of finger 0 and finger 1."""
        return self._counts[0] >= self._samples, self._counts[1] >= self._samples

    def push(self, sample: ForceSample) -> None:
        """Take a sample, which may be the same as before."""
        if self._last_s is None or sample.t_s > self._last_s:
            self._last_s = sample.t_s
            for finger, force_n in enumerate(sample.force_n):
                above = force_n >= self._threshold_n
                self._counts[finger] = self._counts[finger] + 1 if above else 0


class ContactRest:
    """Fingers at rest on the part, until the pads have said with what force.

    Parameters
    ----------
    until_s
        Monotonic time in s at which the rest ends.
    """

    def __init__(self, until_s: float) -> None:
        self._until_s = until_s
        self._samples: deque[ForceSample] = deque(maxlen=_REST_SAMPLES)

    @property
    def force_n(self) -> float:
        """Mean grip force in N of the last samples, at least 0; 0 without any."""
        if not self._samples:
            return 0.0
        return max(0.0, sum(sample.grip_n for sample in self._samples) / len(self._samples))

    def goes_on(self, moment: Moment) -> bool:
        """Take the newest sample and say whether the fingers still rest."""
        sample = moment.sample
        new = not self._samples or (sample is not None and sample.t_s > self._samples[-1].t_s)
        if sample is not None and sample.valid and new:
            self._samples.append(sample)
        return moment.now_s < self._until_s


class ApproachEvent(Enum):
    """What one step of an approach found."""

    CLOSING = "closing"
    CONTACT = "contact"
    LIMIT = "limit"
    OBSTRUCTED = "obstructed"


class Approach:
    """Closes both fingers evenly; a finger that touches waits for the other one.

    The pads decide. Where the fingers stand still at the current limit, one pad is enough (the
    other may be touched beside its taxels); without any pad the way is obstructed.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the start.
    now_s
        Monotonic time in s.
    current_max_a
        Largest goal current in A, from the cap of the force.
    current_a
        Goal current while closing in A. It grows by up to 60 % while the fingers stand still
        untouched: friction at rest differs from servo to servo.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: GripperState,
        *,
        now_s: float,
        current_a: float,
        current_max_a: float,
    ) -> None:
        self._settings = settings
        self._linkage = linkage
        self._current_a = current_a
        self._current_max_a = current_max_a
        self._boost = 1.0
        self._detector = ContactDetector(settings.contact_force_n, settings.contact_samples)
        self._aperture_m = state.aperture_m
        self._was_touched = False
        self._waiting_rad: list[float | None] = [None] * len(state.servos)
        self._was_running = [False] * len(state.servos)
        self._pauses: list[tuple[float, float] | None] = [None] * len(state.servos)
        self._deadline_s = now_s + settings.contact_timeout_s
        self._moving_s = now_s

    @property
    def current_a(self) -> float:
        """Goal current of the servos now in A."""
        return min(self._current_a * self._boost, self._current_max_a)

    def runs_freely(self, state: GripperState) -> bool:
        """Say whether all fingers close steadily and no pad has been touched so far."""
        nominal_rad_s = self._nominal_rad_s(state)
        return not self._was_touched and all(
            _RUNNING_SHARE <= -servo.velocity_rad_s / nominal_rad_s <= 1.0 / _RUNNING_SHARE
            for servo in state.servos
        )

    def _nominal_rad_s(self, state: GripperState) -> float:
        reach_m = sum(self._linkage.opening_per_rad_m(servo.angle_rad) for servo in state.servos)
        return self._settings.approach_speed_m_s / reach_m

    def step(
        self, now_s: float, dt_s: float, state: GripperState, sample: ForceSample | None
    ) -> tuple[ApproachEvent, Sequence[float]]:
        """Return what was found and the goal angle of each servo in rad.

        Parameters
        ----------
        now_s, dt_s
            Monotonic time and time since the last step in s.
        state, sample
            Feedback and newest force sample; one that is not valid adds nothing.
        """
        settings = self._settings
        if sample is not None and sample.valid:
            self._detector.push(sample)
            self._was_touched |= max(sample.force_n) >= self._settings.contact_force_n
        touched = self._detector.touched
        # The goal runs ahead of the fingers by a little only: that is how far they would go on
        # if nobody wrote a new one.
        self._aperture_m = max(
            self._aperture_m - settings.approach_speed_m_s * dt_s, state.aperture_m - _LEAD_M
        )
        paused = self._paused_rad(now_s, state)
        goals = list(self._linkage.angles_rad(self._aperture_m))
        for finger, servo in enumerate(state.servos):
            if len(goals) == 1 or not touched[finger]:
                self._waiting_rad[finger] = None
            elif self._waiting_rad[finger] is None:
                self._waiting_rad[finger] = servo.angle_rad
            still_rad = self._waiting_rad[finger]
            if still_rad is None:
                still_rad = paused[finger]
            if still_rad is not None:
                goals[finger] = still_rad
        still = abs(state.aperture_velocity_m_s) <= _STALL_SPEED_M_S
        if still and not any(touched) and all(rad is None for rad in paused):
            self._boost = min(_LARGEST_BOOST, self._boost + _BOOST_PER_S * dt_s)
        else:
            self._boost = max(1.0, self._boost - 2.0 * _BOOST_PER_S * dt_s)
        return self._event(now_s, state, touched), goals

    def _paused_rad(self, now_s: float, state: GripperState) -> list[float | None]:
        """Return where a finger waits that has just been slowed down, None while it closes.

        The fingers feel a part tens of milliseconds before the pads report it. Whether it is
        one the pads say; without a word from them the finger goes on, now from rest.
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

    def _event(
        self, now_s: float, state: GripperState, touched: tuple[bool, bool]
    ) -> ApproachEvent:
        if state.aperture_m <= self._settings.aperture_min_m:
            return ApproachEvent.LIMIT
        if all(touched):
            return ApproachEvent.CONTACT
        loaded = max(abs(s.current_a) for s in state.servos) >= (
            _STALL_CURRENT_SHARE * self.current_a
        )
        if not loaded or abs(state.aperture_velocity_m_s) > _STALL_SPEED_M_S:
            self._moving_s = now_s
        if now_s - self._moving_s >= _STALL_TIME_S:
            return ApproachEvent.CONTACT if any(touched) else ApproachEvent.OBSTRUCTED
        if now_s >= self._deadline_s:
            return ApproachEvent.LIMIT
        return ApproachEvent.CLOSING
