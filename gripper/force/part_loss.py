"""Decision that a gripped part is gone: what the pads show, against frames, motors and opening.

Force samples alone decide nothing: a control unit whose messages read zero would let a part go that
is held. What they show must be confirmed by another witness: fingers that run together, or a whole
frame that was scanned since. Where a frame still shows load, or the motors press and the fingers
stand, the witnesses contradict each other: that is a fault, and the grip is kept.
"""

from collections import deque
from dataclasses import dataclass
from math import inf, sqrt

from gripper.errors import GripContradicted
from gripper.force.approach import BOOST_PER_S, LARGEST_BOOST, LEAD_M
from gripper.force.estimates.history import History
from gripper.force.loop import Action, Moment
from gripper.force_sensor import ForceSample
from gripper.kinematics import Linkage, motion_current_a, transmissions
from gripper.recent import RecentForce
from gripper.servos.goals import ServoGoal
from gripper.settings import GripperSettings
from gripper.state import GripperState

# Figures without another source are tuned in the simulated cell.
_QUIET_N = 0.08
"""Noise in N of the mean that is the grip force: a fraction of what a ramp must settle within."""
_LEAST_SAMPLES, _LONGEST_S = 3, 0.05
"""Samples of that mean where the sensor is too slow for it, and its longest time in s."""
_LOOK_BACK_S = 0.09
"""Look-back window in s for the force that was there before the pads became empty: 5 samples at
50 Hz."""
_EMPTY_SHARE = 0.25
"""Share of ``contact_force_n`` below which a pad is empty."""
_LOADED_SHARE = 0.5
"""Share of ``contact_force_n`` from which on a frame shows a pad as loaded: several times the noise
of its mean."""
_EMPTY_TIME_S = 0.1
"""Time in s for which pads must be empty before a part may be lost: 5 samples at 50 Hz."""
_SUDDEN_RATIO = 6.0
"""Force over that of an empty pad from which on samples that are empty at once count as that."""
_SUDDEN_SHARE = 0.5
"""Share of the force before that noise must not turn into that of an empty pad."""
_SUDDEN_SIGMAS = 3.0
"""How sure of that the samples must be, in standard deviations of each pad's mean."""
_PAD_NOISE = sqrt(2.0)
"""Noise of one pad over that of the grip force, the mean of both."""
_SUDDEN_S = 0.018
"""Time in s of such samples: one frame at 50 Hz."""
_RUNAWAY_RESERVE = 2.0
"""Closing speed that a ramp on the part may need, in multiples of that by its stiffness."""
_RUNAWAY_HELD_SHARE = 0.5
"""Share of the force before fingers ran ahead above which the pads show that the part is there."""
_RUNAWAY_N = 1.0
"""Force in N by which a part would be loaded more over the way of fingers that run ahead, from
which on the way alone shows that it has gone; by a stiffness that is known well."""
_KNOWN_N = 3.0
"""Force in N from which on the stiffness is known well: it is taken anew with each 0.7 N."""
_BLIND_N, _BLIND_SHARE = 6.0, 0.05
"""Growth of the force in N that its stiffness promises for a way of the fingers, and the share of
it below which the pads do not see what the fingers press on."""
_STEADY_S = 0.3
"""Time in s of a hold until its fingers rest, whatever the part."""
_RUN_M_S, _RUN_M = 0.008, 0.0003
"""Growth of the closing speed in m/s, and way in m, from which on nothing holds the fingers apart:
three units of the servos' velocity, three counts of an encoder. On a part fingers come to rest
under a drive that stays as it is."""
_FIRM_N_M = 1000.0
"""Stiffness in N/m of a part from which on such a way is no swing of fingers and part."""
_FOLLOWS_S = 0.03
"""Time in s for which fingers that press on a part go on at their speed though the drive stays."""
_SOFTEST_N_M = 200.0
"""Stiffness in N/m of a part whose own is not known yet: foam."""
_STAND_S, _STAND_M, _STAND_M_S = 0.04, 0.0001, 0.003
"""Time in s after which fingers that have moved by no more than so many m, and are no faster than
so many m/s, stand: free ones have gone several times as far where the drive is `_PRESSING_N`."""
_PRESSING_N, BREAKAWAY_SHARE = 1.0, 0.3
"""Driving force in N beyond friction at rest that moves free fingers for certain, and the share by
which that friction is larger than in motion, at most."""
_UNDECIDED_S = 0.3
"""Longest time in s until a witness confirms the loss; then it counts as contradicted."""
_TRY_S = 0.5
"""Time in s, beyond that of the way, within which free fingers have closed."""
_CONFIRMING_FRAMES = 3
"""Frames from after the fingers have stopped that confirm that nothing is held: in their mean no
taxel counts as touched any more that was touched before."""
_ADVICE = (
    "A part that one of them still shows is not let go: the goals are frozen and the grip kept. "
    "Look at the part, check control unit, pads and cable, then clear the fault and release"
)


@dataclass(slots=True)
class _Motion:
    """Fingers and their drive at one time."""

    t_s: float
    aperture_m: float
    closing_m_s: float
    drive_n: float


@dataclass(slots=True)
class _Doubt:
    """Samples that show empty pads: the motion when they began, the force before, the frames since.

    ``ripe`` is the motion when they were enough to doubt the part, ``shown`` what they showed; the
    drive stays from then on.
    """

    began: _Motion
    force_n: float
    frames: "FrameMean"
    ripe: _Motion | None = None
    shown: str = ""


class FrameMean:
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
        n = max(1, len(self._forces_n))
        return sum(f[0] for f in self._forces_n) / n, sum(f[1] for f in self._forces_n) / n


class PartWatch:
    """The one place that decides whether a gripped part is gone.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    apertures
        Opening of the last periods in m; its owner adds to it.
    contact_n_m
        Stiffness in N/m that the first touch showed; None where it did not.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        apertures: History,
        contact_n_m: float | None,
    ) -> None:
        self.samples = RecentForce(_QUIET_N, least=_LEAST_SAMPLES, longest_s=_LONGEST_S)
        """Newest force samples, as many as a decision needs."""
        self.empty_n = _EMPTY_SHARE * settings.contact_force_n
        """Force in N below which a pad is empty."""
        self.ran = False
        """Whether the fingers have run together as they do on no part."""
        self._loaded_n = _LOADED_SHARE * settings.contact_force_n
        self._settings = settings
        self._linkage = linkage
        self._apertures = apertures
        self._contact_n_m = contact_n_m
        self._before_n: deque[tuple[float, float]] = deque()
        self._motions: deque[_Motion] = deque()
        self._doubt: _Doubt | None = None
        self._was_held = False
        self._empty_s = 0.0
        self._runaway: tuple[float, float, float] | None = None
        self._ahead: tuple[float, float] | None = None
        self._steady_s = 0.0

    @property
    def doubts(self) -> bool:
        """Whether the samples are not to be used for control: they show a part as gone."""
        return self._doubt is not None and self._doubt.ripe is not None

    @property
    def loaded(self) -> bool:
        """Whether the mean of the last samples shows force on both pads."""
        return bool(self.samples) and min(self.samples.finger_means_n) > self.empty_n

    def resume(self) -> None:
        """Begin again after a pause: what was before it is discarded."""
        self.samples.clear()
        self._before_n.clear()
        self._motions.clear()
        self._doubt = None
        self._empty_s = 0.0

    def take(self, sample: ForceSample) -> None:
        """Add a sample, which may be the same as before."""
        if self.samples.push(sample) is not None:
            self._before_n.append((sample.t_s, self.samples.grip_n))
            while sample.t_s - self._before_n[0][0] > _LOOK_BACK_S:
                self._before_n.popleft()

    def lost(
        self,
        moment: Moment,
        *,
        setpoint_n: float,
        rate_n_s: float,
        stiffness_n_m: float | None,
        drive_n: float,
        pressing_n: float,
    ) -> bool:
        """Return whether the part is gone.

        Both pads have been empty for some time, or are at once where much force was, and the
        fingers run, or a frame shows the same; or the fingers have closed fully and the pads are
        not loaded, or run together as nothing holds them apart. Time without samples, as in a
        stall, shows nothing.

        Parameters
        ----------
        moment
            Feedback and newest sample.
        setpoint_n, rate_n_s
            Force that is asked for in N, and its rate in N/s.
        stiffness_n_m
            Stiffness of the part in N/m, None while it is not known.
        drive_n
            Driving force in N.
        pressing_n
            What the measured currents make beyond friction at rest, in N.

        Raises
        ------
        GripContradicted
            When the samples show empty pads and another witness a part.
        """
        if stiffness_n_m is None:
            stiffness_n_m = self._contact_n_m
        state, sample = moment.state, moment.sample
        motion = _Motion(moment.now_s, state.aperture_m, -state.aperture_velocity_m_s, drive_n)
        self._motions.append(motion)
        while moment.now_s - self._motions[0].t_s > _LOOK_BACK_S:
            self._motions.popleft()
        if sample is not None and sample.valid:
            self.take(sample)
            self._weigh(moment, sample, setpoint_n)
        closed = state.aperture_m < self._settings.aperture_min_m and not self.loaded
        runs_away = self._runs_away(moment, rate_n_s, stiffness_n_m)
        self.ran = closed or runs_away
        return self.ran or self._confirmed(moment, motion, stiffness_n_m, pressing_n)

    def _weigh(self, moment: Moment, sample: ForceSample, setpoint_n: float) -> None:
        """Begin, go on with or end the doubt whether the part is there, by the newest sample."""
        self._was_held |= self.loaded or setpoint_n >= self._settings.contact_force_n
        if not self._was_held:
            # Noise has ended the approach a little early: nothing was there to be lost.
            return
        empty = max(self.samples.finger_means_n) < self.empty_n
        sudden = self._suddenly_empty(setpoint_n)
        doubt = self._doubt
        if doubt is not None and doubt.ripe is not None:
            first_n, second_n = self._newest(doubt.force_n).finger_means_n
            if min(first_n, second_n) > max(self._loaded_n, _SUDDEN_SHARE * doubt.force_n):
                raise self._contradicted(moment, doubt, f"now it is {self._shown()} again")
        elif not (empty or sudden):
            self._doubt, self._empty_s = None, 0.0
            return
        if doubt is None:
            # The first fingers' motion that this sample may have missed.
            since_s = sample.t_s - 2.0 * sample.lag_s
            began = next((m for m in reversed(self._motions) if m.t_s <= since_s), self._motions[0])
            before_n = max((force_n for _, force_n in self._before_n), default=0.0)
            doubt = self._doubt = _Doubt(began, before_n, FrameMean(sample.t_s))
        doubt.frames.push(sample)
        self._empty_s = self._empty_s + moment.dt_s if empty else 0.0
        if doubt.ripe is None and (sudden or self._empty_s > _EMPTY_TIME_S):
            doubt.ripe, doubt.shown = self._motions[-1], self._shown()

    def _confirmed(
        self, moment: Moment, motion: _Motion, stiffness_n_m: float | None, pressing_n: float
    ) -> bool:
        """Return whether another witness confirms that the part is gone, as the samples show."""
        doubt = self._doubt
        if doubt is None or doubt.ripe is None:
            return False
        stiffness_n_m = stiffness_n_m or _SOFTEST_N_M
        if _runs(moment, motion, doubt.began, stiffness_n_m):
            self.ran = stiffness_n_m >= _FIRM_N_M
            return True
        if doubt.frames and min(doubt.frames.finger_means_n) > self._loaded_n:
            first_n, second_n = doubt.frames.finger_means_n
            shows = f"a frame scanned since then shows {first_n:.2f} and {second_n:.2f} N"
            raise self._contradicted(moment, doubt, shows)
        if pressing_n < _PRESSING_N:
            # Free fingers would stand as well: `EmptyGrip` tries whether they do before they open.
            return bool(doubt.frames) or moment.sample is None or moment.sample.frame_s is None
        waited_s = motion.t_s - doubt.ripe.t_s
        if (
            waited_s >= _STAND_S
            and abs(self._apertures.at(motion.t_s - _STAND_S) - motion.aperture_m) <= _STAND_M
            and abs(motion.closing_m_s) <= _STAND_M_S
        ):
            shows = (
                f"the fingers stand at an opening of {1e3 * motion.aperture_m:.1f} mm although the "
                f"motors press with {pressing_n:.1f} N beyond friction"
            )
            raise self._contradicted(moment, doubt, shows)
        if waited_s >= _UNDECIDED_S:
            raise self._contradicted(moment, doubt, "neither frames nor fingers confirm that")
        return False

    def _contradicted(self, moment: Moment, doubt: _Doubt, shows: str) -> GripContradicted:
        since_ms = 1e3 * (moment.now_s - doubt.began.t_s)
        return GripContradicted(
            f"the force samples fell from {doubt.force_n:.2f} N to {doubt.shown} {since_ms:.0f} ms "
            f"ago, below {self.empty_n:.2f} N a pad is empty; {shows}. {_ADVICE}"
        )

    def _shown(self) -> str:
        return "{:.2f} and {:.2f} N".format(*self.samples.newest.force_n)

    def _suddenly_empty(self, setpoint_n: float) -> bool:
        """Return whether next to nothing is left where much force was asked for.

        One sample shows it where its noise cannot hide the force that was there; of a fast sensor
        as many as that takes.
        """
        before_n = max((force_n for _, force_n in self._before_n), default=0.0)
        much_n = min(setpoint_n, before_n)
        if much_n <= _SUDDEN_RATIO * self.empty_n:
            return False
        newest = self._newest(much_n)
        pad_noise_n = _PAD_NOISE * newest.noise_n
        held_n = _SUDDEN_SHARE * much_n
        noisy_n = min(self.empty_n + pad_noise_n, held_n - _SUDDEN_SIGMAS * pad_noise_n)
        return max(newest.finger_means_n) < max(self.empty_n, noisy_n)

    def _newest(self, force_n: float) -> RecentForce:
        """Return as many of the newest samples as distinguish a force from that of empty pads."""
        noise_n = (_SUDDEN_SHARE * force_n - self.empty_n) / _SUDDEN_SIGMAS / _PAD_NOISE
        newest = RecentForce(max(0.0, noise_n), least=1, longest_s=_SUDDEN_S)
        for sample in reversed(list(self.samples)):
            newest.push(sample)
        return newest

    def _runs_away(self, moment: Moment, rate_n_s: float, stiffness_n_m: float | None) -> bool:
        """Return whether the fingers close faster, and farther, than any part lets them.

        A soft part lets them run far where friction breaks, and its stiffness is not known well
        before the force has grown: then the pads decide, by a sample from after the beginning.
        Later, and in a hold that is steady, the way is enough.
        """
        state, sample, settings = moment.state, moment.sample, self._settings
        self._steady_s = 0.0 if rate_n_s != 0.0 else self._steady_s + moment.dt_s
        if stiffness_n_m is None and rate_n_s != 0.0:
            return False
        wanted_m_s = 0.0 if stiffness_n_m is None else max(0.0, rate_n_s / stiffness_n_m)
        closing_m_s = -state.aperture_velocity_m_s
        if closing_m_s <= settings.runaway_speed_m_s + _RUNAWAY_RESERVE * wanted_m_s:
            self._runaway = self._ahead = None
            return False
        force_n = self.samples.grip_n if self.samples else 0.0
        if self._runaway is None:
            self._runaway = moment.now_s, state.aperture_m, force_n
            self._ahead = state.aperture_m, force_n
        began_s, began_m, began_n = self._runaway
        travel_m = began_m - state.aperture_m
        if sample is not None and sample.valid:
            late_n = [one.grip_n for one in self.samples if one.measured_s >= began_s]
            if late_n:
                mean_n = sum(late_n) / len(late_n)
                loaded = mean_n > max(self.empty_n, _RUNAWAY_HELD_SHARE * began_n)
                if loaded:
                    self._runaway = moment.now_s, state.aperture_m, force_n
                    return self._blind(moment, sample, stiffness_n_m)
                return not loaded and travel_m >= settings.runaway_travel_m
        yields_m = inf if stiffness_n_m is None else _RUNAWAY_N / stiffness_n_m
        known = self._steady_s > _STEADY_S or began_n > _KNOWN_N
        return known and travel_m >= max(settings.runaway_travel_m, yields_m)

    def _blind(self, moment: Moment, sample: ForceSample, stiffness_n_m: float | None) -> bool:
        """Return whether fingers that run ahead meet nothing although the pads are loaded.

        The force does not grow with their way. One finger alone may be an encoder that drifts.
        """
        if stiffness_n_m is None or self._ahead is None:
            return False
        began_m, began_n = self._ahead
        travel_m = began_m - self._apertures.at(sample.measured_s)
        promised_n = stiffness_n_m * travel_m
        least_m_s = 0.5 * self._settings.runaway_speed_m_s / len(moment.state.servos)
        together = all(
            -servo.velocity_rad_s * self._linkage.opening_per_rad_m(servo.angle_rad) > least_m_s
            for servo in moment.state.servos
        )
        return (
            together
            and travel_m >= self._settings.runaway_travel_m
            and promised_n >= _BLIND_N
            and self.samples.grip_n - began_n < _BLIND_SHARE * promised_n
        )


def _runs(moment: Moment, motion: _Motion, began: _Motion, stiffness_n_m: float) -> bool:
    """Return whether all fingers have closed since then as they do on no part.

    What the drive has grown by makes a part yield, and what it was before does so for a moment; but
    on a part the fingers become slower then.
    """
    if any(servo.velocity_rad_s > 0.0 for servo in moment.state.servos):
        return False
    yields_m = max(0.0, motion.drive_n - began.drive_n) / stiffness_n_m
    travel_m = began.aperture_m - motion.aperture_m
    before_m_s = max(0.0, began.closing_m_s)
    before_m = before_m_s * min(motion.t_s - began.t_s, _FOLLOWS_S)
    far = travel_m >= _RUN_M + yields_m + before_m and motion.closing_m_s >= before_m_s
    faster = motion.closing_m_s - before_m_s >= _RUN_M_S and travel_m >= yields_m
    return far or faster


class EmptyGrip:
    """Step of control that confirms that nothing is held: before an opening that nobody asked for.

    Where the fingers have not run yet they close, as in an approach, by more than any part yields
    to that; then they stand until the pads have shown once more that they are empty.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the end of the grasp.
    stiffness_n_m
        Stiffness of the part in N/m; None where it is not known.
    approached
        Whether an approach has just ended, to whose current nothing yields any more; as in it the
        current grows then while the fingers stand.
    ran
        Whether the fingers have closed already as they do on no part.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: GripperState,
        *,
        stiffness_n_m: float | None,
        approached: bool,
        ran: bool,
    ) -> None:
        paths = transmissions(settings, linkage, state.angles_rad)
        friction_n = max(path.friction_n for path in paths)
        pressed_n = settings.approach_force_n + BREAKAWAY_SHARE * friction_n
        self._settings = settings
        self._linkage = linkage
        self._current_a = motion_current_a(settings, paths, settings.approach_force_n)
        self._most_a = min(
            (LARGEST_BOOST if approached else 1.0) * self._current_a,
            settings.current_max_a,
            *(path.loading_current_a(settings.force_max_n) for path in paths),
        )
        self._run_m = _RUN_M
        if not approached:
            self._run_m += pressed_n / (stiffness_n_m or _SOFTEST_N_M)
        self._loaded_n = _LOADED_SHARE * settings.contact_force_n
        self._begun = state
        self._goal_m = state.aperture_m
        self._late_s = state.t_s + self._run_m / settings.approach_speed_m_s + _TRY_S
        self._ran = ran
        self._watch_from(state.t_s)

    def _watch_from(self, now_s: float) -> None:
        self._since_s = now_s
        self._frames = FrameMean(now_s)
        self._samples = RecentForce(_QUIET_N, least=_LEAST_SAMPLES, longest_s=_LONGEST_S)

    def step(self, moment: Moment) -> Action:
        """Return the goals of a period; GripContradicted when anything shows a part."""
        state = moment.state
        if self._ran:
            return self._pads(moment)
        travel_m = self._begun.aperture_m - state.aperture_m
        if travel_m >= self._run_m or state.aperture_m <= self._settings.aperture_min_m:
            self._ran = True
            self._watch_from(moment.now_s)
            return Action(goals=self._goals(state, state.aperture_m))
        if moment.now_s >= self._late_s:
            raise GripContradicted(
                f"the force samples show empty pads, but the fingers stand at an opening of "
                f"{1e3 * state.aperture_m:.1f} mm: with {self._current_a:.2f} A, which moves free "
                f"ones, they have closed by {1e3 * travel_m:.1f} of {1e3 * self._run_m:.1f} mm. "
                f"{_ADVICE}"
            )
        self._pads(moment)
        boost = 1.0 + BOOST_PER_S * moment.dt_s
        self._current_a = min(boost * self._current_a, self._most_a)
        self._goal_m = max(
            self._goal_m - self._settings.approach_speed_m_s * moment.dt_s,
            state.aperture_m - LEAD_M,
        )
        return Action(goals=self._goals(state, self._goal_m))

    def _goals(self, state: GripperState, aperture_m: float) -> tuple[ServoGoal, ...]:
        """Return goals that close both fingers evenly to an opening, from where they stand."""
        now_rad = self._linkage.angles_rad(state.aperture_m)
        goal_rad = self._linkage.angles_rad(aperture_m)
        return tuple(
            ServoGoal(angle_rad=servo.angle_rad + goal - now, current_a=self._current_a)
            for servo, now, goal in zip(state.servos, now_rad, goal_rad, strict=True)
        )

    def _pads(self, moment: Moment) -> Action:
        """Return no goals; the last step where frames and samples show empty pads."""
        sample = moment.sample
        if sample is None or not sample.valid:
            return Action()
        self._frames.push(sample)
        after = sample.t_s - 2.0 * sample.lag_s > self._since_s
        if after:
            self._samples.push(sample)
        if not after and max(sample.force_n) > self._loaded_n:
            return Action()
        if sample.frame_s is not None and len(self._frames) < _CONFIRMING_FRAMES:
            return Action()
        shown_n = self._samples.finger_means_n if self._samples else sample.force_n
        frames_n = self._frames.finger_means_n
        if min(shown_n) > self._loaded_n >= min(frames_n) and len(self._samples) < _LEAST_SAMPLES:
            # The noise of one sample loads both pads now and then.
            return Action()
        if min(shown_n) > self._loaded_n or min(frames_n) > self._loaded_n:
            frames = "the frames {:.2f} and {:.2f} N, ".format(*frames_n)
            if sample.frame_s is None:
                frames = ""
            raise GripContradicted(
                f"the grasp has ended without a part at an opening of "
                f"{1e3 * moment.state.aperture_m:.1f} mm, but the force samples show "
                f"{shown_n[0]:.2f} and {shown_n[1]:.2f} N, {frames}from {self._loaded_n:.2f} N on "
                f"both pads something may be held. {_ADVICE}"
            )
        return Action(done=True)
