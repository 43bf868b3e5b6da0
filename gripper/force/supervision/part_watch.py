"""Watch of a gripped part, and the confirmation that nothing is held.

Force samples alone do not decide: a control unit with zero messages would let a held part go.
Another measurement must confirm them: fingers that run together, or a newer whole frame. If a frame
still shows load, or the motors press and the fingers do not run, the measurements contradict each
other: this is a fault, and the grip is kept.
"""

from collections import deque
from math import inf, sqrt
from typing import NamedTuple

from gripper.errors import ForceImbalance, GripContradicted, PartSlipped, PositionContradicted
from gripper.force.approach.approach import Approach, ApproachEvent
from gripper.force.certainty import (
    BRIEF_S,
    EMPTY_SHARE,
    PRESENT_SHARE,
    RUN_STEPS,
    STALLED_S,
    STEADY_S,
    SURE_SDS,
)
from gripper.force.estimates.grip import KNOWN_N, SOFTEST_N_M, Grip
from gripper.force.loop import Action, Moment
from gripper.mechanics.transmission import Mechanics, driving_n, mean_friction_n
from gripper.servos.goal_limits import standing
from gripper.servos.group import frozen
from gripper.settings import GripperSettings
from gripper.values.force_sensor import (
    FRAME_S,
    LEAST_SAMPLES,
    LOOK_BACK_S,
    ForceSample,
    RecentForce,
    mean_n,
)
from gripper.values.state import ServoFeedback

_RUN_M_S = 0.008
"""Growth of the closing speed in m/s above which nothing holds the fingers apart: three counts. On
a part they come to rest under a constant drive. [resolution]"""
_PRESSING_N, _BREAKAWAY_SHARE = 1.0, 0.3
"""Driving force in N beyond friction at rest that certainly moves free fingers, and the largest
ratio of that friction to friction in motion. [assumed]"""
_RUNAWAY_RESERVE, _RUNAWAY_N = 2.0, 1.0
"""Largest closing speed of a ramp on the part, in multiples of that by its stiffness; and growth of
the load in N by a known stiffness above which the travel alone shows that the part is gone.
[tuned]"""
_BLIND_N, _BLIND_SHARE = 6.0, 0.05
"""Growth of the force in N that the stiffness predicts for a travel. Below this share of it the
pads do not measure the load of the fingers. [tuned]"""
CREEP_M = 0.0005
"""Distance in m by which foam may yield after a rise: a sixth of the yield of two pads of 3 mm.
[chosen]"""
_SUDDEN_RATIO = 6.0
"""Least force, relative to an empty pad, before a sudden loss of force on the pads. [tuned]"""
_FALL_S = 3.0 * FRAME_S
"""Time in s from which a sudden fall of the force is a slip: checks of the pads need less, and the
force before it is known for longer."""
_PAD_NOISE = sqrt(2.0)
"""Noise of one pad over that of the grip force, the mean of both. [statistics]"""
_ADVICE = (
    "One of them still shows a part: the goals are frozen and the grip is kept. "
    "Look at the part, check control unit, pads and cable, then clear the fault and release"
)
_CLOSED_ADVICE = (
    "The fingers are closed (gripper.aperture_min_mm): a part is too small to be held, or the pads "
    "press on each other because gripper.approach_speed_mm_s is high. The grip is kept: look, then "
    "clear the fault and release"
)


class PadSamples:
    """Newest force samples, and the force before them.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self.recent = RecentForce()
        """As many of the newest as a decision needs."""
        self.empty_n = EMPTY_SHARE * settings.contact_force_n
        """Force in N below which a pad is empty."""
        self.loaded_n = PRESENT_SHARE * settings.contact_force_n
        """Force in N above which the mean of frames shows a pad as loaded."""
        self._before_n: deque[tuple[float, float]] = deque()

    def take(self, sample: ForceSample) -> None:
        """Add a sample, which may be the same as before."""
        while self._before_n and sample.t_s - self._before_n[0][0] > LOOK_BACK_S:
            self._before_n.popleft()
        if self.recent.push(sample) is not None and self.recent.complete:
            self._before_n.append((sample.t_s, self.recent.grip_n))

    @property
    def loaded(self) -> bool:
        """Whether the mean of the last samples shows force on both pads."""
        return bool(self.recent) and min(self.recent.finger_means_n) > self.empty_n

    @property
    def empty(self) -> bool:
        """Whether the mean of the last samples shows no force on either pad."""
        return max(self.recent.finger_means_n) < self.empty_n

    @property
    def before_n(self) -> float:
        """Largest grip force in N of the look-back window, a mean of enough samples."""
        return max([force_n for _, force_n in self._before_n], default=0.0)

    def much_n(self, planned_n: float) -> float:
        """Return the force in N that was there, and planned; 0 where it is too small to judge."""
        much_n = min(planned_n, self.before_n)
        return much_n if much_n > _SUDDEN_RATIO * self.empty_n else 0.0

    def suddenly_empty(self, planned_n: float) -> bool:
        """Return whether almost no force is left although ``planned_n`` N were planned.

        One sample is enough if its noise cannot hide the earlier force; a fast sensor needs more.
        """
        much_n = self.much_n(planned_n)
        if much_n == 0.0:
            return False
        newest_noise_n = (PRESENT_SHARE * much_n - self.empty_n) / SURE_SDS / _PAD_NOISE
        newest = RecentForce(max(0.0, newest_noise_n), one_frame=True)
        for sample in reversed(list(self.recent)):
            newest.push(sample)
        pad_noise_n = _PAD_NOISE * newest.noise_n
        held_n = PRESENT_SHARE * much_n
        noisy_n = min(self.empty_n + pad_noise_n, held_n - SURE_SDS * pad_noise_n)
        return max(newest.finger_means_n) < max(self.empty_n, noisy_n)


class _FrameMean:
    """Mean force of the whole frames that were scanned after a moment.

    Parameters
    ----------
    since_s
        That moment, monotonic time in s.
    """

    def __init__(self, since_s: float) -> None:
        self._newest_s = since_s
        self._forces_n: list[tuple[float, float]] = []

    def __len__(self) -> int:
        return len(self._forces_n)

    def push(self, sample: ForceSample) -> None:
        """Add the frame of a sample, which may be the same as before."""
        if sample.frame_s is not None and sample.frame_s > self._newest_s:
            self._newest_s = sample.frame_s
            self._forces_n.append(sample.frame_n)

    @property
    def finger_means_n(self) -> tuple[float, float]:
        """Mean force in N on finger 0 and finger 1; 0 without a frame."""
        return mean_n(self._forces_n)


class _Motion(NamedTuple):
    """Fingers and their drive at one time."""

    t_s: float
    aperture_m: float
    closing_m_s: float
    drive_n: float


class _Suspicion:
    """Samples that show empty pads: the fingers, the force and the frames since their beginning.

    Parameters
    ----------
    began
        The fingers' motion at the beginning.
    force_n
        Grip force before it in N.
    since_s
        Monotonic time of the first of these samples in s.
    """

    def __init__(self, began: _Motion, force_n: float, since_s: float) -> None:
        self.began, self.force_n = began, force_n
        self.frames = _FrameMean(since_s)
        self.empty_s = 0.0
        """Time in s for which the pads have been empty."""
        self.acts_s = inf
        """Monotonic time in s from which the samples are not used for control."""
        self.fell_to = ""
        """What the samples read then, as text."""


class PartWatch:
    """Decides whether a gripped part is gone, and compares its pads with the fingers.

    Parameters
    ----------
    grip
        What is known of the grip; its owner adds to it.
    contact_n_m
        Stiffness in N/m that the first touch showed; None where it did not.
    widest_m
        Opening in m beyond which no part can press on both pads.
    """

    def __init__(self, grip: Grip, contact_n_m: float | None, *, widest_m: float = inf) -> None:
        self.pads = PadSamples(grip.settings)
        """Newest force samples."""
        self.ran = False
        """Whether the fingers have run together, unlike on any part."""
        self._grip = grip
        self._contact_n_m = contact_n_m
        self._motions: deque[_Motion] = deque()
        self._suspicion: _Suspicion | None = None
        self._was_held = False
        self._run_from: tuple[float, float, float] | None = None
        self._ahead_from: tuple[float, float, float] | None = None
        self._steady_s = 0.0
        self._widest_m, self._sunk_m = widest_m, grip.stiffness.apertures.newest
        self._rose_s: float | None = None
        self._contradicted_s = self._uneven_s = 0.0
        self._fell_s = inf

    @property
    def suspicious(self) -> bool:
        """Whether the samples must not be used for control: they show a part as gone."""
        return self._suspicion is not None and self._suspicion.acts_s < inf

    @property
    def uneven(self) -> bool:
        """Whether the pads differ by more than the imbalance that is allowed."""
        return self._uneven_s > 0.0

    def resume(self) -> None:
        """Begin again after a pause: earlier values are discarded.

        The force before the pause counts until it is too old.
        """
        self.pads.recent.clear()
        self._motions.clear()
        self._suspicion = None
        self._uneven_s = 0.0

    def update(self, moment: Moment) -> bool:
        """Add one period and return whether the part is gone.

        It is gone in these cases: both pads are empty for some time, or suddenly after much force,
        and the fingers run or a frame is also empty; the fingers have closed fully and the pads are
        not loaded; the fingers run together without resistance. Time without samples, e.g. in a
        stall, does not count.

        Raises
        ------
        GripContradicted
            When the samples show empty pads but another measurement shows a part.
        """
        grip, pads, state, sample = self._grip, self.pads, moment.state, moment.sample
        closing_m_s = -state.aperture_velocity_m_s
        self._motions.append(_Motion(moment.now_s, state.aperture_m, closing_m_s, grip.balance_n))
        while moment.now_s - self._motions[0].t_s > LOOK_BACK_S:
            self._motions.popleft()
        if sample is not None and sample.valid:
            pads.take(sample)
            # If noise has ended the approach slightly early, no part can be lost.
            self._was_held |= grip.planned_n >= grip.settings.contact_force_n
            if self._was_held:
                self._compare(moment, sample)
        stiffness_n_m = grip.stiffness.stiffness_n_m or self._contact_n_m
        closed = state.aperture_m < grip.settings.aperture_min_m and not pads.loaded
        runs_away = self._runs_away(moment, stiffness_n_m)
        self.ran = closed or runs_away
        return self.ran or (self.suspicious and self._confirmed(moment, stiffness_n_m))

    def _compare(self, moment: Moment, sample: ForceSample) -> None:
        """Start a suspicion when a valid sample shows empty pads; end it when one shows load."""
        pads, suspicion = self.pads, self._suspicion
        empty, sudden = pads.empty, pads.suddenly_empty(self._grip.planned_n)
        if suspicion is None:
            if not (empty or sudden):
                return
            # The first fingers' motion that this sample may have missed.
            since_s = sample.t_s - 2.0 * sample.lag_s
            motions = self._motions
            began = next((m for m in reversed(motions) if m.t_s <= since_s), motions[0])
            self._suspicion = suspicion = _Suspicion(began, pads.before_n, sample.t_s)
        suspicion.frames.push(sample)
        suspicion.empty_s = suspicion.empty_s + moment.dt_s if empty else 0.0
        if suspicion.acts_s < inf:
            return
        if not (empty or sudden):
            self._suspicion = None
        elif sudden or suspicion.empty_s > BRIEF_S:
            suspicion.acts_s = moment.now_s
            suspicion.fell_to = "{:.2f} and {:.2f} N".format(*pads.recent.newest.force_n)

    def _confirmed(self, moment: Moment, stiffness_n_m: float | None) -> bool:
        """Return whether another measurement confirms the loss; else may raise GripContradicted.

        Free fingers without a drive also stand: `EmptyGrip` tests this before they open.
        """
        suspicion, motion, grip = self._suspicion, self._motions[-1], self._grip
        assert suspicion is not None
        stiffness_n_m = stiffness_n_m or SOFTEST_N_M
        step_m = grip.stiffness.step_m
        if _run(moment, motion, suspicion.began, stiffness_n_m, RUN_STEPS * step_m):
            return True
        if suspicion.frames and min(suspicion.frames.finger_means_n) > self.pads.loaded_n:
            first_n, second_n = suspicion.frames.finger_means_n
            shows = f"a frame scanned since then shows {first_n:.2f} and {second_n:.2f} N"
            raise self._contradicted(moment, suspicion, shows)
        paths = grip.mechanics.transmissions(moment.state.angles_rad)
        friction_n = (1.0 + _BREAKAWAY_SHARE) * mean_friction_n(paths)
        pressing_n = driving_n(moment.state, paths) - friction_n
        if pressing_n < _PRESSING_N:
            return bool(suspicion.frames) or moment.sample is None or moment.sample.frame_s is None
        if motion.t_s - suspicion.acts_s >= STEADY_S:
            shows = (
                f"the fingers do not run together from {1e3 * motion.aperture_m:.1f} mm although "
                f"the motors press with {pressing_n:.1f} N beyond friction"
            )
            raise self._contradicted(moment, suspicion, shows)
        return False

    def _contradicted(self, moment: Moment, suspicion: _Suspicion, shows: str) -> GripContradicted:
        since_ms = 1e3 * (moment.now_s - suspicion.began.t_s)
        return GripContradicted(
            f"the force samples fell from {suspicion.force_n:.2f} N to {suspicion.fell_to} "
            f"{since_ms:.0f} ms ago, below {self.pads.empty_n:.2f} N a pad is empty; {shows}. "
            f"{_ADVICE}"
        )

    def _runs_away(self, moment: Moment, stiffness_n_m: float | None) -> bool:
        """Return whether the fingers close faster, and farther, than is possible on a part.

        On a soft part they run far when friction breaks, and its stiffness is uncertain before the
        force has grown: then the pads decide, by a sample after the start. Later, and in a steady
        hold, the travel is enough.
        """
        state, sample, settings = moment.state, moment.sample, self._grip.settings
        rate_n_s, recent = self._grip.rate_n_s, self.pads.recent
        self._steady_s = 0.0 if rate_n_s != 0.0 else self._steady_s + moment.dt_s
        if stiffness_n_m is None and rate_n_s != 0.0:
            return False
        wanted_m_s = 0.0 if stiffness_n_m is None else max(0.0, rate_n_s / stiffness_n_m)
        most_m_s = settings.runaway_speed_m_s + _RUNAWAY_RESERVE * wanted_m_s
        if -state.aperture_velocity_m_s <= most_m_s:
            self._run_from = self._ahead_from = None
            return False
        force_n = recent.grip_n if recent else 0.0
        if self._run_from is None:
            self._run_from = self._ahead_from = moment.now_s, state.aperture_m, force_n
        began_s, began_m, began_n = self._run_from
        travel_m = began_m - state.aperture_m
        if sample is not None and sample.valid:
            late_n = [late.grip_n for late in recent if late.measured_s >= began_s]
            if late_n:
                mean_n = sum(late_n) / len(late_n)
                if mean_n > max(self.pads.empty_n, PRESENT_SHARE * began_n):
                    self._run_from = moment.now_s, state.aperture_m, force_n
                    return self._meets_nothing(state, sample, stiffness_n_m)
                return travel_m >= settings.runaway_travel_m
        yields_m = inf if stiffness_n_m is None else _RUNAWAY_N / stiffness_n_m
        known = self._steady_s > STEADY_S or began_n > KNOWN_N
        return known and travel_m >= max(settings.runaway_travel_m, yields_m)

    def _meets_nothing(
        self, state: ServoFeedback, sample: ForceSample, stiffness_n_m: float | None
    ) -> bool:
        """Return whether fingers that run ahead meet nothing although the pads are loaded.

        The force does not grow with their travel. One finger alone may be a drifting encoder.
        """
        if stiffness_n_m is None or self._ahead_from is None:
            return False
        settings, linkage = self._grip.settings, self._grip.mechanics.linkage
        _, began_m, began_n = self._ahead_from
        travel_m = began_m - self._grip.stiffness.apertures.at(sample.measured_s)
        promised_n = stiffness_n_m * travel_m
        least_m_s = 0.5 * settings.runaway_speed_m_s / len(state.servos)
        return (
            all(
                -servo.velocity_rad_s * linkage.opening_per_rad_m(servo.angle_rad) > least_m_s
                for servo in state.servos
            )
            and travel_m >= settings.runaway_travel_m
            and promised_n >= _BLIND_N
            and self.pads.recent.grip_n - began_n < _BLIND_SHARE * promised_n
        )

    def force_falls(self) -> bool:
        """Return whether the newest sample shows a sudden fall of the force that was planned.

        It is not for control: a law that follows it would open the fingers. Raises PartSlipped when
        the fall lasts.
        """
        newest, much_n = self.pads.recent.newest, self.pads.much_n(self._grip.planned_n)
        low_n = PRESENT_SHARE * much_n - SURE_SDS * newest.noise_n
        if much_n == 0.0 or newest.grip_n > low_n:
            self._fell_s = inf
            return False
        self._fell_s = min(self._fell_s, newest.t_s)
        if newest.t_s - self._fell_s < _FALL_S:
            return True
        raise PartSlipped(
            f"the grip force fell from {much_n:.2f} N to {newest.grip_n:.2f} N although nothing "
            f"opened the fingers: the part slips, or the pads are at fault. The goals are frozen, "
            f"nothing grips again by itself: look, check the pads, clear the fault, then release"
        )

    def check_pads(self, moment: Moment, *, rises: bool) -> None:
        """Compare the newest samples with the opening, and those of both fingers.

        ``rises``: whether the set-point is higher than in the last period.

        Raises
        ------
        PositionContradicted
            When pads are loaded although the fingers, by their position, cannot press on a part.
        ForceImbalance
            When the forces of the fingers differ for too long.
        """
        if rises or self._rose_s is None:
            self._rose_s = moment.now_s
        if moment.now_s - self._rose_s <= BRIEF_S:
            self._sunk_m = moment.state.aperture_m
        # No part presses on both pads of fingers that are wider open than at the contact, or
        # closed. A small part in the foam may sink further by the creep of the foam.
        settings, aperture_m = self._grip.settings, moment.state.aperture_m
        least_m = min(settings.least_pressed_m, self._sunk_m - CREEP_M)
        possible = least_m <= aperture_m <= self._widest_m or not self.pads.loaded
        self._contradicted_s = 0.0 if possible else self._contradicted_s + moment.dt_s
        first_n, second_n = self.pads.recent.finger_means_n
        if self._contradicted_s >= BRIEF_S:
            raise PositionContradicted(
                f"the servos report an opening of {aperture_m * 1e3:.1f} mm while the pads "
                f"measure {first_n:.2f} and {second_n:.2f} N on a part that can be from "
                f"{least_m * 1e3:.1f} to {self._widest_m * 1e3:.1f} mm wide: a position is wrong, "
                f"or the pads press on each other; the goals are frozen and the grip kept. Look at "
                f"the part, check encoder, horn and linkage, then clear the fault and release"
            )
        allowed_n = max(settings.imbalance_n, settings.imbalance_share * 0.5 * (first_n + second_n))
        even = abs(first_n - second_n) <= allowed_n
        self._uneven_s = 0.0 if even else self._uneven_s + moment.dt_s
        if self._uneven_s > settings.imbalance_s:
            raise ForceImbalance(
                f"the fingers press with {first_n:.2f} and {second_n:.2f} N, a difference of "
                f"{allowed_n:.2f} N is allowed for {settings.imbalance_s} s: both are frozen; "
                f"check whether a finger is blocked or a pad is blind"
            )


def _run(
    moment: Moment, motion: _Motion, began: _Motion, stiffness_n_m: float, run_m: float
) -> bool:
    """Return whether all fingers have closed by ``run_m`` m since then, unlike on any part.

    A grown drive makes a part yield, but on a part the fingers then become slower.
    """
    if any(servo.velocity_rad_s > 0.0 for servo in moment.state.servos):
        return False
    yields_m = max(0.0, motion.drive_n - began.drive_n) / stiffness_n_m
    travel_m = began.aperture_m - motion.aperture_m
    before_m_s = max(0.0, began.closing_m_s)
    far = travel_m >= run_m + yields_m and motion.closing_m_s >= before_m_s
    faster = motion.closing_m_s - before_m_s >= _RUN_M_S and travel_m >= yields_m
    return far or faster


class EmptyGrip:
    """Step of control that confirms that nothing is held, before an opening without a request.

    Fingers that have not run yet close, as in an approach, by more than any part would yield. Then
    they stand until the pads have shown once more that they are empty.

    Parameters
    ----------
    mechanics
        Of the gripper.
    state
        Feedback at the end of the grasp.
    stiffness_n_m
        Stiffness in N/m of the part that may yield to the current of an approach. None where an
        approach has just ended, so that nothing yields; the current may then grow while the fingers
        stand.
    ran
        Whether the fingers have already closed, unlike on any part.
    """

    def __init__(
        self, mechanics: Mechanics, state: ServoFeedback, *, stiffness_n_m: float | None, ran: bool
    ) -> None:
        self._settings = settings = mechanics.settings
        self._approach = Approach(mechanics, state, may_boost=stiffness_n_m is None)
        self._step_m = self._approach.stiffness.step_m
        self._run_m = RUN_STEPS * self._step_m
        if stiffness_n_m is not None:
            paths = mechanics.transmissions(state.angles_rad)
            friction_n = max(path.friction_n for path in paths)
            pressed_n = settings.approach_force_n + _BREAKAWAY_SHARE * friction_n
            self._run_m += pressed_n / stiffness_n_m
        self._loaded_n = PRESENT_SHARE * settings.contact_force_n
        self._begun_m = state.aperture_m
        self._late_s = state.t_s + self._run_m / settings.approach_speed_m_s + STALLED_S
        self._ran = ran
        self._watch_from(state.t_s)

    def _watch_from(self, now_s: float) -> None:
        self._since_s = now_s
        self._frames = _FrameMean(now_s)
        self._samples = RecentForce()

    def step(self, moment: Moment) -> Action:
        """Return the goals of a period. Raises GripContradicted when anything shows a part."""
        if self._ran:
            return self._pads(moment)
        state, approach = moment.state, self._approach
        # A finger that is ahead waits: none opens.
        goals = frozen(approach.step(moment).goals or (), state)
        travel_m = self._begun_m - state.aperture_m
        if travel_m >= self._run_m or approach.event is ApproachEvent.LIMIT:
            self._ran = True
            self._watch_from(moment.now_s)
            return Action(goals=standing(goals, state))
        self._pads(moment)
        if moment.now_s >= self._late_s or approach.event is not ApproachEvent.CLOSING:
            raise GripContradicted(
                f"the force samples show empty pads, but the fingers stand at an opening of "
                f"{1e3 * state.aperture_m:.1f} mm: with {max(approach.currents_a):.2f} A, which "
                f"moves free ones, they have closed by {1e3 * travel_m:.1f} of "
                f"{1e3 * self._run_m:.1f} mm. {_ADVICE}"
            )
        return Action(goals=goals)

    def _pads(self, moment: Moment) -> Action:
        """Return no goals; the last step where frames and samples show empty pads."""
        sample = moment.sample
        if sample is None or not sample.valid:
            return Action()
        self._frames.push(sample)
        after = sample.t_s - 2.0 * sample.lag_s > self._since_s
        if after:
            self._samples.push(sample)
        few = sample.frame_s is not None and len(self._frames) < LEAST_SAMPLES
        if few or (not after and max(sample.force_n) > self._loaded_n):
            return Action()
        means_n = self._samples.finger_means_n if self._samples else sample.force_n
        frames_n = self._frames.finger_means_n
        if min(means_n) > self._loaded_n >= min(frames_n) and not self._samples.complete:
            # The noise of one sample sometimes loads both pads.
            return Action()
        if min(means_n) > self._loaded_n or min(frames_n) > self._loaded_n:
            frames = "the frames {:.2f} and {:.2f} N, ".format(*frames_n)
            if sample.frame_s is None:
                frames = ""
            opening_m, least_m = moment.state.aperture_m, self._settings.aperture_min_m
            closed = opening_m - least_m <= RUN_STEPS * self._step_m
            advice = _CLOSED_ADVICE if closed else _ADVICE
            raise GripContradicted(
                f"the grasp has ended without a part at an opening of "
                f"{1e3 * opening_m:.1f} mm, but the force samples show "
                f"{means_n[0]:.2f} and {means_n[1]:.2f} N, {frames}more than "
                f"{self._loaded_n:.2f} N on both pads: something may be held, or the zero of the "
                f"pads has drifted. {advice}"
            )
        return Action(done=True)
