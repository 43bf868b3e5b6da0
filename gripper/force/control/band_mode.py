"""Mode of control that follows the friction band: falls, and all else where no motion is planned.

The gearing holds a load by friction: at a driving force u (torque constant times current over
effective radius) the grip force may be anywhere from u - phi to u + phi, phi being the friction
band. While the force rises it is u - phi, while it falls u + phi. The mode follows this with a
model of play (rate-independent hysteresis): the modelled force moves only when the band pushes it.
Each edge of the band has its own bias, kept while the force moves in the other direction.

Instead of a proportional-integral controller this is a feed-forward through the inverse of the
model plus a slowly learnt bias: the low-pass filtered difference between sensor and model at the
time of each sample. Delay and noise of the sensor do not enter the fast path, and a saturated drive
causes no wind-up. Within a dead band the drive does not change, so that friction cannot turn a
small error into a limit cycle.

While the force changes, a small square wave on the drive keeps the gearing from sticking: friction
at rest is larger than in motion, and every breakaway would be a jump. Within the band nothing
moves, and the drive crosses it fast. Near the edge the drive creeps, because motor and part are a
spring and a mass with little damping: a step of the drive would overshoot to twice its change.
"""

from collections import deque

from gripper.force.control.motion_mode import MotionMode
from gripper.force.control.period import Mode, Period
from gripper.force.estimates.grip import Grip
from gripper.force.loop import YOUNG_S
from gripper.values.force_sensor import ForceSample
from gripper.values.recent import FRAME_S, LOOK_BACK_S
from gripper.values.state import GRAIN_M, STANDING_M_S

_ARRIVED_N = 0.02
"""Distance in N from the end of a change at which the force follows the set-point itself.
[tuned]"""
_AFTER_FALL_S = 0.1
"""Time in s after a fall of the modelled force in which friction may still hold more force.
[tuned]"""
_ANCHOR_S = 1.75 * FRAME_S
"""Least duration in s of a mean that shows the edge of the friction band on the way down: three
frames."""
_CATCH_UP_S = 0.2
"""Time in s within which a moving set-point reaches the force by itself. [tuned]"""
_LONGEST_MEAN, _LONGER_EACH_S = 5.0, 0.3
"""Growth of the mean's length at rest, relative to a ramp, by one for each 0.3 s. [tuned]"""
_CREEP_S = 0.5
"""Time in s of a hold in which the foam creeps fast: if errors are corrected, the mean stays short.
[assumed]"""
_CAP_TIME_S = 0.05
"""Time constant in s with which the drive reaches its largest value: moving masses and part
oscillate, and would push the force above the cap. [tuned]"""
_CREEP_PER_RAMP = 1.5
"""Rate of the drive near the edge of the band over that of the set-point: it must keep up.
[tuned]"""
_FORCE_TIME_S = 0.015
"""Time constant in s of the force that stiffens a soft part: a fraction of its oscillation period.
[tuned]"""
_STANDING_M = 2 * GRAIN_M
"""Largest change of the opening in m, in the look-back window, of standing fingers: two counts of
the encoder."""


class BandMode(Mode):
    """Mode of control that drives the force along the edges of the friction band.

    Parameters
    ----------
    grip
        Estimates and set-point of the grip.
    now_s
        Monotonic time in s.
    """

    def __init__(self, grip: Grip, now_s: float) -> None:
        self._grip = grip
        self._tuning = grip.settings.force_loop
        self._setpoint_n: float | None = None
        self._rising = True
        self._breaking_since_s: float | None = now_s
        self._breaking: deque[tuple[float, float]] = deque()
        self._dither = 0.0
        self._edge_bias_n = {True: 0.0, False: 0.0}
        self._held_since_s = now_s
        self._fell_s = now_s - _AFTER_FALL_S
        self._quick_n, self._quick_s = grip.estimate.model_n, now_s
        self._damping_n_s_m = grip.swing_n_s_m(0.5 * self._tuning.damping_n_s_m)

    def enter(self, period: Period, before: Mode) -> None:
        """Continue from the force after a motion; after a wait, from the force before it."""
        if isinstance(before, MotionMode):
            self._setpoint_n, self._rising, self._dither = before.setpoint_n, True, 0.0
            self._held_since_s = self._breaking_since_s = before.moved_s

    def step(self, period: Period) -> float:
        """Return the driving force in N of one period.

        Raises
        ------
        LimitExceeded
            When sensor and model disagree by more than is plausible for some time, or the sensor
            jumps to more force than the current can make at once.
        """
        grip, dt_s, friction_n = self._grip, period.moment.dt_s, period.friction_n
        setpoint_n = arriving_n(
            grip.asked_n, dt_s, period.setpoint_n, period.end_n, self._tuning.end_time_s
        )
        grip.rate_n_s = (setpoint_n - grip.asked_n) / dt_s if dt_s > 0.0 else 0.0
        grip.asked_n = setpoint_n
        held = setpoint_n == self._setpoint_n
        before_n = setpoint_n if self._setpoint_n is None else self._setpoint_n
        rate_n_s = (setpoint_n - before_n) / dt_s if dt_s > 0.0 else 0.0
        swing_n = self._stiffening_n(period) - self._braking_n(period)
        self._learn(period, setpoint_n, rate_n_s)
        if not held:
            self._held_since_s = period.moment.now_s
        wanted_n = None
        if not (held and period.may_plan):
            wanted_n = self._edge_n(period, setpoint_n, rate_n_s, held=held)
        if wanted_n is None:
            self._dither = 0.0
            wanted_n = grip.quiet_n
            if period.taper and grip.quiet_n > grip.estimate.model_n:
                given_back_n = self._tuning.taper_n_s * dt_s
                wanted_n = max(grip.estimate.model_n, grip.quiet_n - given_back_n)
        else:
            self._dither = self._tuning.dither_share * (1.0 if self._dither <= 0.0 else -1.0)
        wanted_n = self._approached(wanted_n, abs(setpoint_n - before_n), friction_n, dt_s)
        self._setpoint_n = setpoint_n
        lowest_n = -self._tuning.push_open_share * friction_n
        left_n = max(0.0, period.drive_max_n - grip.quiet_n)
        wanted_n = min(wanted_n, grip.quiet_n + left_n * min(1.0, dt_s / _CAP_TIME_S))
        grip.quiet_n = min(max(wanted_n, lowest_n), period.drive_max_n)
        self._move_model(period)
        crest_n = min(self._dither * friction_n, period.drive_max_n - grip.quiet_n)
        return min(grip.quiet_n + swing_n + crest_n, period.drive_max_n - period.inertia_n)

    def _edge_n(
        self, period: Period, setpoint_n: float, rate_n_s: float, *, held: bool
    ) -> float | None:
        """Return the drive at the edge of the friction band that moves the force to its target.

        None if the force is near enough: the drive may stay.
        """
        tuning, estimate, friction_n = self._tuning, self._grip.estimate, period.friction_n
        target_n = setpoint_n - estimate.bias_n
        if self._rising:
            # An uncertain force is approached from below: the way back is twice the friction.
            target_n -= tuning.caution * max(0.0, estimate.doubt_n - tuning.settled_doubt_n)
        error_n = target_n - estimate.model_n
        reversal_n = max(tuning.reversal_band_n, tuning.reversal_band_share * setpoint_n)
        band_n = tuning.hold_band_n if held else tuning.dead_band_n
        # A moving set-point reaches the force by itself.
        rise_n = band_n if self._rising else reversal_n + _CATCH_UP_S * max(0.0, -rate_n_s)
        fall_n = band_n if not self._rising else reversal_n + _CATCH_UP_S * max(0.0, rate_n_s)
        if error_n > rise_n:
            target_n += estimate.bias_n
            self._turn(period.moment.now_s, rising=True)
            return target_n - estimate.bias_n + friction_n
        if error_n < -fall_n:
            self._turn(period.moment.now_s, rising=False)
            return period.yielding_n(setpoint_n - estimate.bias_n)
        return None

    def _approached(
        self, wanted_n: float, change_n: float, friction_n: float, dt_s: float
    ) -> float:
        """Return the drive of this period on the way to the wanted one: fast, then creeping."""
        tuning, model_n = self._tuning, self._grip.estimate.model_n
        creep_n = tuning.creep_n_s * dt_s + _CREEP_PER_RAMP * change_n
        fast_n = tuning.drive_rate_n_s * dt_s
        inner_n = (1.0 - tuning.creep_share) * friction_n
        drive_n = self._grip.quiet_n
        if wanted_n > drive_n:
            free_n = max(drive_n, min(drive_n + fast_n, model_n + inner_n))
            return min(wanted_n, max(free_n, drive_n + creep_n))
        free_n = min(drive_n, max(drive_n - fast_n, model_n - inner_n))
        return max(wanted_n, min(free_n, drive_n - creep_n))

    def _move_model(self, period: Period) -> None:
        """Move the modelled force as far as the friction band around the drive pushes it."""
        estimate, drive_n = self._grip.estimate, self._grip.quiet_n
        now_s, friction_n = period.moment.now_s, period.friction_n
        most_n = period.held_n(drive_n)
        model_n = min(max(estimate.model_n, drive_n - friction_n), most_n)
        if model_n < estimate.model_n:
            self._fell_s = now_s
        doubt_n = 0.0
        if model_n != estimate.model_n and self._breaking_since_s is not None:
            self._breaking_since_s = None
            doubt_n = self._tuning.friction_doubt * friction_n
        estimate.move(now_s, model_n, doubt_n=doubt_n)

    def _turn(self, now_s: float, *, rising: bool) -> None:
        """Reverse the direction at the present force: each edge of the band has its own bias."""
        if rising is not self._rising:
            bias_n = self._grip.estimate.bias_n
            self._edge_bias_n[self._rising] = bias_n
            known_n = self._edge_bias_n[rising]
            self._grip.estimate.correct(bias_n - known_n, known_n)
            self._rising = rising
            self._breaking_since_s = now_s
            self._breaking.clear()

    def _learn(self, period: Period, setpoint_n: float, rate_n_s: float) -> None:
        """Correct the bias by the newest sample, and refuse an implausible one."""
        grip, estimate, sample = self._grip, self._grip.estimate, period.sample
        now_s, state = period.moment.now_s, period.state
        before_m = grip.apertures.at(now_s - LOOK_BACK_S)
        jumped = abs(state.aperture_m - before_m) < _STANDING_M and estimate.jumps(
            sample,
            estimate.unexplained_n(sample) - estimate.bias_n,
            setpoint_n,
            period.friction_n,
            fell=now_s - self._fell_s < _AFTER_FALL_S,
        )
        if sample.t_s > estimate.sample_s and not jumped:
            drift_n_rs = self._tuning.bias_drift_n_rs * (
                1.0 + abs(rate_n_s) / self._tuning.bias_rate_n_s
            )
            # At rest the mean becomes longer, so that noise does not ratchet the force up.
            lasts_s = now_s - self._held_since_s - (_CREEP_S if period.moment.young else 0.0)
            drift_n_rs /= 1.0 + min(max(lasts_s, 0.0) / _LONGER_EACH_S, _LONGEST_MEAN)
            speed_m_s = 0.5 * abs(state.aperture_velocity_m_s)
            doubt_n_s_m = grip.motor_share * self._tuning.motion_doubt_n_s_m
            estimate.learn(sample, drift_n_rs=drift_n_rs, motion_n=doubt_n_s_m * speed_m_s)
            since_s = self._breaking_since_s
            if not self._rising and since_s is not None and sample.t_s > since_s:
                self._anchor(sample, setpoint_n, period)
        estimate.check(now_s, sample, period.friction_n, period.doubt_n)

    def _anchor(self, sample: ForceSample, setpoint_n: float, period: Period) -> None:
        """On the way down, use the present drive as the band's edge when the force gets there.

        With less friction than in the model the force falls before the modelled edge; the sensor
        then shows the true edge.
        """
        breaking, estimate, drive_n = self._breaking, self._grip.estimate, self._grip.quiet_n
        friction_n = period.friction_n
        breaking.append((sample.t_s, sample.grip_n))
        while len(breaking) > 2 and sample.t_s - breaking[1][0] >= _ANCHOR_S:
            breaking.popleft()
        mean_n = sum(grip_n for _, grip_n in breaking) / len(breaking)
        inside = estimate.model_n - drive_n < (1.0 - self._tuning.creep_share) * friction_n
        if sample.t_s - breaking[0][0] < _ANCHOR_S or mean_n > setpoint_n or inside:
            return
        model_n = period.held_n(drive_n)
        estimate.correct(model_n - estimate.model_n, mean_n - model_n)
        self._breaking_since_s = None

    def _braking_n(self, period: Period) -> float:
        """Return the reduction of the drive in N, because the fingers run ahead.

        For fingers that lag behind the increase is at most the square wave on the drive: a far too
        small stiffness, e.g. from pads that fail on the approach, would demand a very large speed.
        """
        grip = self._grip
        stiffness_n_m = grip.stiffness.stiffness_n_m
        wanted_m_s = 0.0 if stiffness_n_m is None else grip.rate_n_s / stiffness_n_m
        closing_m_s = -period.state.aperture_velocity_m_s
        reached_m_s = min(max(wanted_m_s, min(closing_m_s, 0.0)), max(closing_m_s, 0.0))
        lag_n = self._damping_n_s_m * (wanted_m_s - reached_m_s)
        most_n = self._tuning.dither_share * period.friction_n
        return self._damping_n_s_m * (closing_m_s - reached_m_s) - min(max(lag_n, -most_n), most_n)

    def _stiffening_n(self, period: Period) -> float:
        """Return the addition to the drive in N that makes a soft part respond like a stiffer one.

        Motor and soft part oscillate so slowly that a ramp ends before the force has followed.
        """
        grip, sample = self._grip, period.sample
        if sample.t_s > self._quick_s:
            share = min(1.0, (sample.t_s - self._quick_s) / _FORCE_TIME_S)
            self._quick_n += share * (sample.grip_n - self._quick_n)
            self._quick_s = sample.t_s
        stiffness_n_m = grip.stiffness.stiffness_n_m
        still = abs(period.state.aperture_velocity_m_s) < STANDING_M_S
        if stiffness_n_m is None or (still and grip.rate_n_s == 0.0):
            return 0.0
        acted_on_s = period.moment.now_s - sample.measured_s + grip.settings.period_s
        young = (YOUNG_S / max(acted_on_s, YOUNG_S)) ** 2
        gain = max(0.0, young * self._tuning.stiffened_n_m / stiffness_n_m - 1.0)
        short_n = grip.asked_n - self._quick_n
        return min(gain * short_n, self._tuning.dither_share * period.friction_n)


def arriving_n(
    force_n: float, dt_s: float, setpoint_n: float, end_n: float, end_time_s: float
) -> float:
    """Return the force in N that follows a set-point and slows down before the end of its change.

    The moving masses and the part oscillate with little damping: after an abrupt end of the rate
    the force overshoots. The force is never beyond the set-point and never faster; its rate is at
    most the remaining change over ``end_time_s``.

    Parameters
    ----------
    force_n
        Force of the last step in N.
    dt_s
        Time since then in s.
    setpoint_n, end_n
        Set-point of the ramp now, and where its present change ends, in N.
    end_time_s
        Time constant of the arrival in s; 0 follows the set-point itself.
    """
    left_n = end_n - force_n
    if end_time_s <= 0.0 or abs(left_n) <= _ARRIVED_N:
        return setpoint_n
    limit_n = force_n + left_n * min(1.0, dt_s / end_time_s)
    return min(setpoint_n, limit_n) if left_n > 0.0 else max(setpoint_n, limit_n)
