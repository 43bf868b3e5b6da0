"""Control of the grip force of one grasp: goals of the servos, stiffness, friction, lost parts."""

from collections import deque
from collections.abc import Sequence
from math import inf
from statistics import median

from gripper.errors import ForceImbalance, PositionContradicted
from gripper.force.controller import ForceController, History, SetpointFilter
from gripper.force.loop import Moment
from gripper.force.part_loss import BREAKAWAY_SHARE, PartWatch
from gripper.force.ramp_motion import ContactObserver, RampMotion
from gripper.force_sensor import ForceSample
from gripper.impact import impact_limit
from gripper.kinematics import Linkage, Transmission, mean_friction_n, transmissions
from gripper.servos.goals import (
    ServoGoal,
    closing_margin_rad,
    most_closed_rad,
    pressing_speed_m_s,
)
from gripper.settings import GripperSettings
from gripper.state import GripperState

# Figures without another source are tuned in the simulated cell.
_MEAN_SAMPLES = 3
"""Samples whose mean a stiffness is taken with: 60 ms at 50 Hz."""
_KNOWN_N = 3.0
"""Force in N from which on the first touch shows the stiffness well."""
_GIVE_RAD = 0.03
"""How far in rad a goal may open beyond the contact: pads and part are deeper there by no more."""
_CONTRADICTED_S = 0.1
"""Time in s for which loaded pads contradict a position before that is an error: 5 samples."""
_CONTRADICTED_ADVICE = (
    "the goals are frozen and the grip kept. Look at the part, check encoder, horn and linkage, "
    "then clear the fault and release"
)
_SINKS_S, _CREEP_M = 0.1, 0.0005
"""Time in s after a rise until the fingers stand, and the way in m by which foam may go on yielding
after it: a sixth of what two pads of 3 mm give."""
_TORQUE_DOUBT = 0.03
"""Share of the cap of the force that the drive leaves free: torque of the servos, their inertia."""
_LEVER_M = 0.06
"""Lever in m between servo and fingertip for which damping, inertia and doubt by motion are given:
what a motor weighs at the fingertip goes with the inverse of its square."""
_INERTIA_N_S_M = 100.0
"""Drive in N left free below the cap of the force for each m/s of closing: on a part of 10 N/mm the
inertia of the fingers adds so much to the force that their drive makes."""

_FORCE_TIME_S = 0.015
"""Time constant in s of the force that stiffens a soft part: a fraction of what its swing takes."""
_YOUNG_S = 0.015
"""Age in s of a sample at the end of the period in which it acts, up to which all of the stiffening
is stable; older ones allow less by the square of their age, those of frames next to nothing."""

_STANDING_S, _STANDING_M = 0.09, 0.0002
"""Time in s in which the opening changes by no more than so many m where the fingers stand: two
counts of the encoder."""
_DAMPED_SHARE = 0.25
"""Share of its momentum that damping takes from a finger in one period, at the most."""
_STILL_M_S = 0.002
"""Rate of the opening in m/s below which the fingers stand."""

_FAST_N_S = 6.0
"""Rate in N/s from which on a rise is a planned motion: below, friction at rest decides."""
_FAST_PERIOD_S = 0.0065
"""Longest time in s between two goals of a planned motion, half of the time constant of its speed:
in a slower loop the fingers would run too far."""
_LATE_PERIOD_S = 0.012
"""Time in s since the last period from which on a motion is given up for slower control."""
_CORRECTED_N = {False: 0.05, True: 0.1}
_CORRECTED_DOUBT_N = 0.06
"""Error in N, beside the doubt of the force, of a hold that is made up for by a motion, up and
down (True: foam creeps, and the way down costs twice the friction), and how well the force must be
known."""
_PAUSE_S = 0.05
"""Least time in s between two such motions."""
_HARDENS, _WAY_DOUBT_M = 1.5, 1e-4
"""Stiffness at the contact over the mean one up to it, as foam has it, and what the way up to the
contact may be short by, in m: one count of the encoders."""

_TOUCH_SHARE = 0.3
"""Share of ``contact_force_n`` below which a sample shows no touch."""
_SLOPE_N = 0.7
"""Growth of the force in N over which one stiffness is taken: several times the noise."""
_BLOCK_S = 0.018
"""Time in s over which faster samples count as one, their mean: just below a period of 50 Hz."""
_SHORTEST_M = 1e-4
"""Least travel in m that a stiffness is taken over: the resolution of the opening."""
_STIFFEST_N_M = 1e5
"""Largest stiffness in N/m: a steel part between foam pads is far below it."""

_AFTER_START_S = 0.06
"""Time in s from the start of free motion until its current is that of friction alone."""
_BEFORE_CONTACT_S = 0.05
"""Time in s before the end of free motion that is left out: the pads report a contact late."""
_WINDOW_S = 0.4
"""Time in s of free motion that the friction is taken over."""
_LEAST_PERIODS = 12
"""Least periods of free motion that the friction is taken over: 0.06 s at 200 Hz."""
_LOW_SHARE, _HIGH_SHARE = 0.5, 1.6
"""Range of the friction found, as a share of the model's: beyond it something else brakes."""


class GripControl:
    """Step of control from the set-point of the grip force to the goals of the servos.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the contact; the fingers are not driven open beyond it by more than a pad's
        thickness.
    touch_m
        Opening in m at which both pads were first loaded: the fingers are not driven open beyond
        it, however much force the pads report.
    force_n
        Grip force at the contact in N.
    drive_n
        Driving force at the contact in N.
    now_s
        Monotonic time in s.
    stiffness
        Stiffness of the part.
    friction_share
        Friction of the gearing as a share of the model's.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: GripperState,
        *,
        touch_m: float,
        force_n: float,
        drive_n: float,
        now_s: float,
        stiffness: "StiffnessEstimate",
        friction_share: float,
    ) -> None:
        tuning = settings.force_loop
        self.setpoint_n = force_n
        """Last set-point of the grip force in N."""
        self._settings = settings
        self._linkage = linkage
        self._friction_share = friction_share
        self._stiffness = stiffness
        self._apertures = History()
        self._apertures.add(now_s, state.aperture_m)
        self._contact_rad = state.angles_rad
        self._deepest_rad = state.angles_rad
        self._least_rad = most_closed_rad(settings, linkage)
        self._touch_m = touch_m
        self._stop_rad: tuple[float, ...] | None = None
        self._widest_m = state.aperture_m + _GIVE_RAD * sum(
            linkage.opening_per_rad_m(angle_rad) for angle_rad in state.angles_rad
        )
        self._sunk_m, self._rose_s = state.aperture_m, now_s
        self._contradicted_s = 0.0
        # Loaded so much at the first touch: stiff, or no part at all.
        yielded_m = max(touch_m - state.aperture_m, _SHORTEST_M)
        contact_n_m = force_n / yielded_m if force_n > _KNOWN_N else None
        self._watch = PartWatch(settings, linkage, self._apertures, contact_n_m)
        self._filter = SetpointFilter(force_n, tuning.end_time_s)
        self._controller = ForceController(tuning, force_n=force_n, drive_n=drive_n, now_s=now_s)
        self._drive_n = drive_n
        self._quick_n, self._quick_s = force_n, now_s
        closed = transmissions(settings, linkage, linkage.angles_rad(0.0))
        self._weight = sum((_LEVER_M / path.radius_m) ** 2 for path in closed) / len(closed)
        self._mass_kg = impact_limit(settings, linkage).mass_kg
        # More than this would swing a light finger that is looked at rarely.
        stable_n_s_m = _DAMPED_SHARE * self._mass_kg / settings.period_s
        self._damping_n_s_m = min(0.5 * self._weight * tuning.damping_n_s_m, stable_n_s_m)
        self._inertia_n_s_m = min(self._weight * _INERTIA_N_S_M, stable_n_s_m)
        self._uneven_s = 0.0
        # Both pads yield by what the opening shrinks.
        way_m = max(touch_m - state.aperture_m, 0.0) + _WAY_DOUBT_M
        self._pad_n_m = 2.0 * _HARDENS * max(force_n, self._watch.empty_n) / way_m
        self._motion: RampMotion | None = None
        self._last_motion: RampMotion | None = None
        self._moved_s = now_s
        self._measured_n = drive_n
        self._lacking_n: dict[bool, float] = {}

    @property
    def force_n(self) -> float:
        """Mean of the last samples of the grip force in N."""
        samples = self._watch.samples
        return samples.grip_n if samples else self._controller.model_n

    @property
    def doubts(self) -> bool:
        """Whether the samples show a part as gone and no other witness does yet."""
        return self._watch.doubts

    @property
    def ran(self) -> bool:
        """Whether the fingers have run together as they do on no part."""
        return self._watch.ran

    def resume(self) -> None:
        """Begin again after a pause: samples from before it are discarded."""
        self._watch.resume()
        self._uneven_s = 0.0

    def goals(
        self,
        moment: Moment,
        setpoint_n: float,
        *,
        arrival_n: float | None = None,
        taper: bool = False,
    ) -> tuple[ServoGoal, ...]:
        """Return the goals of one period.

        Parameters
        ----------
        moment
            Feedback and a valid force sample.
        setpoint_n
            Grip force that is asked for in N.
        arrival_n
            Where the present change of force ends in N; None where it is not changing.
        taper
            True during a long hold.

        Raises
        ------
        ForceImbalance
            When the fingers press with different forces for too long.
        LimitExceeded
            When sensor and model disagree, see `ForceController.step`.
        PositionContradicted
            When the pads are loaded where the fingers, by their position, cannot press on a part.
        """
        rises_n = setpoint_n - self.setpoint_n
        self.setpoint_n = setpoint_n
        sample, state = moment.sample, moment.state
        self._apertures.add(moment.now_s, state.aperture_m)
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        if sample is None or not sample.valid or self._watch.doubts:
            # Nothing new to go by: a sample that is young enough was there before, or the samples
            # show a part as gone and no other witness does yet. The crest of the square wave must
            # not stay meanwhile.
            self._drive_n = min(self._drive_n, self._controller.drive_n)
            self._motion = None
            return self._servo_goals(state, paths)
        self._watch.take(sample)
        if rises_n > 0.0:
            self._rose_s = moment.now_s
        if moment.now_s - self._rose_s <= _SINKS_S:
            self._sunk_m = state.aperture_m
        self._check_position(moment.dt_s, state)
        self._check_balance(moment.dt_s)
        end_n = setpoint_n if arrival_n is None else arrival_n
        friction_n = self._friction_share * mean_friction_n(paths)
        drive_max_n = self._drive_max_n(state, paths)
        inertia_n = self._inertia_n_s_m * max(0.0, -state.aperture_velocity_m_s)
        young = moment.now_s - sample.measured_s <= _YOUNG_S
        if self._motion is not None and (self._motion.over or rises_n < 0.0):
            if self._motion.over:
                self._filter.force_n = setpoint_n
            self._motion, self._moved_s = None, moment.now_s
        quick = self._settings.period_s <= _FAST_PERIOD_S and moment.dt_s <= _LATE_PERIOD_S
        if not quick:
            self._motion = None
        if self._motion is None and quick and young and moment.dt_s > 0.0:
            if rises_n > _FAST_N_S * moment.dt_s:
                now_n = self._controller.model_n + self._controller.bias_n
                self._begin_motion(moment, setpoint_n - rises_n, now_n)
            elif rises_n == 0.0 and arrival_n in (None, setpoint_n):
                self._correct(moment, setpoint_n)
        if self._motion is not None:
            self._drive_n = self._rise(
                moment,
                sample,
                end_n,
                self._motion,
                paths,
                friction_n=friction_n,
                drive_max_n=drive_max_n - inertia_n,
            )
            return self._servo_goals(state, paths)
        filtered_n = self._filter.step(moment.dt_s, setpoint_n, end_n)
        speed_m_s = 0.5 * abs(state.aperture_velocity_m_s)
        before_m = self._apertures.at(moment.now_s - _STANDING_S)
        drive_n = self._controller.step(
            moment.now_s,
            moment.dt_s,
            filtered_n,
            sample,
            friction_n=friction_n,
            braking_n=self._braking_n(state, friction_n)
            - self._stiffening_n(moment, sample, friction_n),
            motion_n=self._weight * self._settings.force_loop.motion_doubt_n_s_m * speed_m_s,
            drive_max_n=drive_max_n,
            standing=abs(state.aperture_m - before_m) < _STANDING_M,
            taper=taper,
            corrected=young,
        )
        self._drive_n = min(drive_n, drive_max_n - inertia_n)
        return self._servo_goals(state, paths)

    def _correct(self, moment: Moment, setpoint_n: float) -> None:
        """Begin a motion that makes up for an error of a hold, where there is one."""
        controller = self._controller
        now_n = controller.model_n + controller.bias_n
        known = controller.doubt_n <= _CORRECTED_DOUBT_N
        if not known or moment.now_s - self._moved_s < _PAUSE_S:
            return
        falls = setpoint_n < now_n
        if falls and self._stop_rad is not None:
            # The fingers may not open any farther.
            return
        if abs(setpoint_n - now_n) > _CORRECTED_N[falls] + controller.doubt_n:
            self._begin_motion(moment, now_n, now_n, falls=falls, corrects=True)

    def _begin_motion(
        self,
        moment: Moment,
        setpoint_n: float,
        force_n: float,
        *,
        falls: bool = False,
        corrects: bool = False,
    ) -> None:
        """Begin a motion of the force from what it is now."""
        paths = transmissions(self._settings, self._linkage, moment.state.angles_rad)
        self._measured_n = driving_n(moment.state, paths)
        before = self._last_motion
        if before is not None:
            self._pad_n_m = before.observer.stiffness_n_m
            self._lacking_n[before.falls] = before.observer.lacking_n
        observer = ContactObserver(
            mass_kg=self._mass_kg,
            now_s=moment.now_s - moment.dt_s,
            force_n=max(0.0, force_n),
            doubt_n=self._controller.doubt_n,
            drive_n=self._drive_n,
            lacking_n=self._lacking_n.get(
                falls, self._lacking_n.get(not falls, -self._controller.bias_n)
            ),
            stiffness_n_m=self._pad_n_m,
        )
        self._motion = self._last_motion = RampMotion(
            observer, setpoint_n=setpoint_n, falls=falls, corrects=corrects
        )

    def _rise(
        self,
        moment: Moment,
        sample: ForceSample,
        end_n: float,
        motion: RampMotion,
        paths: Sequence[Transmission],
        *,
        friction_n: float,
        drive_max_n: float,
    ) -> float:
        """Return the driving force in N of one period of a fast rise."""
        observer = motion.observer
        measured_n = driving_n(moment.state, paths)
        jumped = self._controller.jumps(
            sample, observer.unexplained_n(sample), self.setpoint_n, friction_n
        )
        observer.step(
            moment.now_s,
            moment.dt_s,
            drive_n=0.5 * (self._measured_n + measured_n),
            friction_n=friction_n,
            speed_m_s=-0.5 * moment.state.aperture_velocity_m_s,
            sample=None if jumped else sample,
        )
        self._measured_n = measured_n
        impact = impact_limit(self._settings, self._linkage, moment.state.angles_rad)
        drive_n = motion.drive_n(
            moment.dt_s,
            self.setpoint_n,
            end_n,
            friction_n=friction_n,
            drive_max_n=drive_max_n,
            speed_max_m_s=pressing_speed_m_s(self._settings, impact, self.setpoint_n),
            acting_n=self._drive_n,
        )
        self._filter.force_n, self._filter.rate_n_s = motion.plan.force_n, motion.plan.rate_n_s
        self._controller.follow(
            moment.now_s,
            self.setpoint_n,
            sample,
            force_n=observer.force_n,
            doubt_n=observer.doubt_n,
            drive_n=drive_n,
            lacking_n=observer.lacking_n,
            friction_n=friction_n,
        )
        return drive_n

    def part_lost(self, moment: Moment) -> bool:
        """Return whether the part is gone; see `PartWatch.lost`. Comes before `goals`."""
        paths = transmissions(self._settings, self._linkage, moment.state.angles_rad)
        breakaway_n = (1.0 + BREAKAWAY_SHARE) * self._friction_share * mean_friction_n(paths)
        return self._watch.lost(
            moment,
            setpoint_n=self._filter.force_n,
            rate_n_s=self._filter.rate_n_s,
            stiffness_n_m=self._stiffness.stiffness_n_m,
            drive_n=self._controller.drive_n,
            pressing_n=driving_n(moment.state, paths) - breakaway_n,
        )

    def _check_position(self, dt_s: float, state: GripperState) -> None:
        """Raise PositionContradicted where loaded pads have contradicted the opening for long.

        No part presses on both pads where the fingers stand wider open than at the contact, or
        closed: then the count of a position drifts, and what is gripped is gripped all the same.
        A small part that has sunk into the foam may go on sinking as far as foam creeps.
        """
        least_m = min(self._settings.least_pressed_m, self._sunk_m - _CREEP_M)
        if least_m <= state.aperture_m <= self._widest_m or not self._watch.loaded:
            self._contradicted_s = 0.0
            return
        self._contradicted_s += dt_s
        if self._contradicted_s < _CONTRADICTED_S:
            return
        first_n, second_n = self._watch.samples.finger_means_n
        raise PositionContradicted(
            f"the servos report an opening of {state.aperture_m * 1e3:.1f} mm while the pads "
            f"measure {first_n:.2f} and {second_n:.2f} N on a part that can be from "
            f"{least_m * 1e3:.1f} to {self._widest_m * 1e3:.1f} mm wide: a position is wrong, or "
            f"the pads press on each other; {_CONTRADICTED_ADVICE}"
        )

    def _braking_n(self, state: GripperState, friction_n: float) -> float:
        """Return what the drive is lowered by, in N, because the fingers run ahead.

        Fingers that lag behind are driven on by no more than the square wave on the drive: a
        stiffness that is far too small, as from pads that fail on the approach, makes the speed
        that the ramp needs as large as can be.
        """
        tuning = self._settings.force_loop
        stiffness_n_m = self._stiffness.stiffness_n_m
        wanted_m_s = 0.0 if stiffness_n_m is None else self._filter.rate_n_s / stiffness_n_m
        closing_m_s = -state.aperture_velocity_m_s
        reached_m_s = min(max(wanted_m_s, min(closing_m_s, 0.0)), max(closing_m_s, 0.0))
        lag_n = self._damping_n_s_m * (wanted_m_s - reached_m_s)
        most_n = tuning.dither_share * friction_n
        return self._damping_n_s_m * (closing_m_s - reached_m_s) - min(max(lag_n, -most_n), most_n)

    def _stiffening_n(self, moment: Moment, sample: ForceSample, friction_n: float) -> float:
        """Return what is added to the drive, in N, so that a soft part answers like a stiffer one.

        Motor and a soft part swing so slowly that a ramp is over before its force has followed.
        """
        tuning = self._settings.force_loop
        if sample.t_s > self._quick_s:
            share = min(1.0, (sample.t_s - self._quick_s) / _FORCE_TIME_S)
            self._quick_n += share * (sample.grip_n - self._quick_n)
            self._quick_s = sample.t_s
        stiffness_n_m = self._stiffness.stiffness_n_m
        still = abs(moment.state.aperture_velocity_m_s) < _STILL_M_S
        if stiffness_n_m is None or (still and self._filter.rate_n_s == 0.0):
            return 0.0
        acted_on_s = moment.now_s - sample.measured_s + self._settings.period_s
        young = (_YOUNG_S / max(acted_on_s, _YOUNG_S)) ** 2
        gain = max(0.0, young * tuning.stiffened_n_m / stiffness_n_m - 1.0)
        short_n = self._filter.force_n - self._quick_n
        return min(gain * short_n, tuning.dither_share * friction_n)

    def _drive_max_n(self, state: GripperState, paths: Sequence[Transmission]) -> float:
        """Return the largest driving force in N that the caps of current and force allow.

        Where something pushes the fingers open, the cap of the force limits the drive too.
        """
        cap_a = self._settings.current_cap_a(state.temperature_c)
        cap_n = self._settings.force_max_n * (1.0 - _TORQUE_DOUBT)
        friction_share = min(1.0, self._friction_share)
        return min(
            min(cap_a * path.kt_nm_a / path.radius_m, cap_n + friction_share * path.friction_n)
            for path in paths
        )

    def _check_balance(self, dt_s: float) -> None:
        """Raise ForceImbalance when the fingers' forces have differed for too long."""
        settings = self._settings
        first_n, second_n = self._watch.samples.finger_means_n
        allowed_n = max(settings.imbalance_n, settings.imbalance_share * 0.5 * (first_n + second_n))
        if abs(first_n - second_n) <= allowed_n:
            self._uneven_s = 0.0
            return
        self._uneven_s += dt_s
        if self._uneven_s > settings.imbalance_s:
            raise ForceImbalance(
                f"the fingers press with {first_n:.2f} and {second_n:.2f} N, a difference of "
                f"{allowed_n:.2f} N is allowed for {settings.imbalance_s} s: both are frozen; "
                f"check whether a finger is blocked or a pad is blind"
            )

    def _servo_goals(
        self, state: GripperState, paths: Sequence[Transmission]
    ) -> tuple[ServoGoal, ...]:
        """Return the goals that make the driving force."""
        drive_n = self._drive_n
        goals = []
        self._deepest_rad = tuple(map(min, self._deepest_rad, state.angles_rad))
        if state.aperture_m < self._touch_m:
            self._stop_rad = None
        elif self._stop_rad is None:
            self._stop_rad = state.angles_rad
        stop_rad = self._stop_rad or (inf,) * len(paths)
        for servo, path, settings, contact_rad, deepest_rad, widest_rad, least_rad in zip(
            state.servos,
            paths,
            self._settings.servos,
            self._contact_rad,
            self._deepest_rad,
            stop_rad,
            self._least_rad,
            strict=True,
        ):
            current_a = min(
                abs(drive_n) * path.radius_m / path.kt_nm_a, self._settings.current_max_a
            )
            margin_rad = closing_margin_rad(settings.servo_model, current_a)
            # In mode 5 the goal current is a magnitude: the side of the goal position is its sign.
            # A position that drifts open must not take a closing goal to the open side with it.
            if drive_n >= 0.0:
                angle_rad = max(deepest_rad - margin_rad, min(least_rad, servo.angle_rad))
            else:
                angle_rad = min(servo.angle_rad + margin_rad, contact_rad + _GIVE_RAD, widest_rad)
            goals.append(
                ServoGoal(
                    angle_rad=angle_rad,
                    current_a=current_a,
                    setpoint_n=self.setpoint_n,
                    friction_share=self._friction_share,
                )
            )
        return tuple(goals)


def driving_n(state: GripperState, paths: Sequence[Transmission]) -> float:
    """Return the driving force in N that the measured currents make, friction left aside."""
    return sum(
        -servo.current_a * path.kt_nm_a / path.radius_m
        for servo, path in zip(state.servos, paths, strict=True)
    ) / len(paths)


class StiffnessEstimate:
    """Stiffness of the gripped part: growth of the grip force over travel, from the touch on.

    It need not be exact: it distinguishes foam from steel.

    Parameters
    ----------
    settings
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self._touch_n = _TOUCH_SHARE * settings.contact_force_n
        self._apertures = History()
        self._block: list[tuple[float, float]] = []
        self._block_s = -inf
        self._pairs: deque[tuple[float, float]] = deque(maxlen=_MEAN_SAMPLES)
        self._anchor: tuple[float, float] | None = None
        self._sample_s: float | None = None
        self._stiffness_n_m: float | None = None

    @property
    def stiffness_n_m(self) -> float | None:
        """Grip force gained for each m that the opening shrinks; None before it was measured."""
        return self._stiffness_n_m

    def push(self, moment: Moment) -> None:
        """Add the opening of now and the newest sample, which may be the same as before."""
        self._apertures.add(moment.now_s, moment.state.aperture_m)
        sample = moment.sample
        if sample is None or not sample.valid or sample.t_s == self._sample_s:
            return
        self._sample_s = sample.t_s
        self._block.append((sample.grip_n, self._apertures.at(sample.measured_s)))
        if sample.t_s - self._block_s < _BLOCK_S:
            return
        n = len(self._block)
        pair = (sum(one[0] for one in self._block) / n, sum(one[1] for one in self._block) / n)
        self._block_s = sample.t_s
        self._block.clear()
        if pair[0] < self._touch_n:
            self._anchor = pair
            self._pairs.clear()
            return
        self._pairs.append(pair)
        if self._anchor is None or len(self._pairs) < _MEAN_SAMPLES:
            return
        mean_n = sum(pair[0] for pair in self._pairs) / _MEAN_SAMPLES
        mean_m = sum(pair[1] for pair in self._pairs) / _MEAN_SAMPLES
        if mean_n - self._anchor[0] >= _SLOPE_N:
            travel_m = max(self._anchor[1] - mean_m, _SHORTEST_M)
            self._stiffness_n_m = min((mean_n - self._anchor[0]) / travel_m, _STIFFEST_N_M)
            self._anchor = (mean_n, mean_m)


class FrictionEstimate:
    """Friction of the gearing, from the current that closes the empty fingers on an approach.

    Torque constant and friction of a servo differ from the figures of its model; their ratio is
    what decides where in the friction band a drive is, and that is this current.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    """

    def __init__(self, settings: GripperSettings, linkage: Linkage) -> None:
        self._settings = settings
        self._linkage = linkage
        self._since_s: float | None = None
        self._shares: deque[tuple[float, float]] = deque()

    def push(self, moment: Moment, *, running: bool) -> None:
        """Add one period.

        Parameters
        ----------
        moment
            Feedback of the period.
        running
            True while all fingers close steadily and nothing touches.
        """
        now_s, state = moment.now_s, moment.state
        if not running:
            self._since_s = None
            return
        if self._since_s is None:
            self._since_s = now_s
        if now_s - self._since_s < _AFTER_START_S:
            return
        paths = transmissions(self._settings, self._linkage, state.angles_rad)
        share = sum(
            -servo.current_a * path.kt_nm_a / path.friction_nm
            for servo, path in zip(state.servos, paths, strict=True)
        ) / len(paths)
        self._shares.append((now_s, share))
        while self._shares[0][0] < now_s - _WINDOW_S - _BEFORE_CONTACT_S:
            self._shares.popleft()

    @property
    def measured(self) -> bool:
        """Whether the fingers have run freely for long enough."""
        return len(self._free_shares()) >= _LEAST_PERIODS

    def friction_share(self) -> float:
        """Return the friction as a share of the model's; 1 where too little was measured."""
        shares = self._free_shares()
        if len(shares) < _LEAST_PERIODS:
            return 1.0
        return min(max(median(shares), _LOW_SHARE), _HIGH_SHARE)

    def _free_shares(self) -> list[float]:
        if not self._shares:
            return []
        last_s = self._shares[-1][0] - _BEFORE_CONTACT_S
        return [share for then_s, share in self._shares if then_s <= last_s]
