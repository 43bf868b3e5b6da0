"""Force controller: from the set-point of the grip force to the driving force of the fingers.

The gearing holds a load by friction: at a driving force u (torque constant times current over
effective radius) the grip force may be anywhere from u - phi to u + phi, phi being the friction
band. While the force rises it is u - phi, while it falls u + phi. The loop follows this with a
model of play (hysteresis without rate): the modelled force moves only when the band pushes it.
Each edge of the band has its own bias, kept while the force goes the other way.

A proportional-integral controller in this setting is a feed-forward through the inverse of the
model plus a slowly learnt bias, the low-passed difference between sensor and model at the time of
each sample: delay and noise of the sensor do not enter the fast path, a saturated drive winds
nothing up, and within a dead band the drive stays where it is, so that friction cannot turn a
small error into a limit cycle.

While the force changes, a small square wave on the drive keeps the gearing from sticking: friction
at rest is larger than in motion, and every breakaway would be a jump. Within the band nothing
moves and the drive crosses it fast; near the edge it creeps, because motor and part are a spring
and a mass with little damping: a step of the drive would swing the force to twice its change.
"""

from collections import deque
from math import sqrt

from gripper.errors import LimitExceeded
from gripper.force_sensor import ForceSample
from gripper.settings import ForceLoopSettings

_ARRIVED_N = 0.02
"""Distance in N from the end of a change at which the filter follows the set-point itself."""
_HISTORY_LENGTH = 128
"""Periods kept of a value: 0.64 s at 200 Hz, several times the delay of a sensor."""
_IMPLAUSIBLE_S = 0.3
"""Time in s for which sensor and model may disagree: 15 samples at 50 Hz."""
_JUMP_N, _JUMP_SHARE, _JUMP_FRICTION_SHARE, _JUMP_SIGMAS = 0.8, 0.15, 0.17, 4.0
"""Sudden growth of the measured force that no drive makes: in N, as a share of the set-point and of
the friction, and beside the noise of a sample in its standard deviations. Friction that breaks
makes an eighth of it at most where the fingers do not give back force."""
_JUMP_S = 0.015
"""Time in s that it must last: two samples at 50 Hz."""
_AFTER_FALL_S, _STICKS_SHARE = 0.1, 0.6
"""Time in s after the modelled force has fallen in which friction may still hold more force, as a
share of the friction: that differs from the model's by a third at most, and by both edges."""
_ANCHOR_S = 0.035
"""Least time in s over which a mean shows the edge of the friction band on the way down: three
samples at 50 Hz."""
_CATCH_UP_S = 0.2
"""Time in s within which a moving set-point catches up with the force by itself."""
_LONGEST_MEAN, _LONGER_EACH_S = 5.0, 0.3
"""How much longer than on a ramp the mean of the samples gets at rest, by one for each 0.3 s."""
_CREEP_S = 0.5
"""Time in s of a hold in which the foam creeps fast: where errors are made up for, the mean stays
short."""
_MOTION_S = 0.02
"""Time in s for which the motion of the fingers makes the model equally wrong: faster samples do
not tell more."""
_CAP_TIME_S = 0.05
"""Time constant in s with which the drive arrives at its largest value: moving masses and part are
a swing, and what they add to the force there would be above the cap."""
_CREEP_PER_RAMP = 1.5
"""Rate of the drive near the edge of the band over that of the set-point: it must keep up."""


class ForceController:
    """Controller of the grip force in one grasp; no clock, no bus.

    Parameters
    ----------
    settings
        Tuning.
    force_n
        Grip force at the start in N.
    drive_n
        Driving force at the start in N.
    now_s
        Monotonic time in s.
    """

    def __init__(
        self, settings: ForceLoopSettings, *, force_n: float, drive_n: float, now_s: float
    ) -> None:
        self._settings = settings
        self._model_n = force_n
        self._drive_n = drive_n
        self._setpoint_n: float | None = None
        self._rising = True
        self._breaking_since_s: float | None = now_s
        self._breaking: deque[tuple[float, float]] = deque()
        self._dither = 0.0
        self._bias_n = 0.0
        self._edge_bias_n = {True: 0.0, False: 0.0}
        self._doubt_n2 = settings.start_doubt_n**2
        self._history = History()
        self._history.add(now_s, force_n)
        self._sample_s = now_s
        self._held_since_s = now_s
        self._implausible_since_s: float | None = None
        self._jumped_s: float | None = None
        self._fell_s = now_s - _AFTER_FALL_S

    @property
    def drive_n(self) -> float:
        """Driving force in N, without the square wave on it; below 0 it pushes open."""
        return self._drive_n

    @property
    def model_n(self) -> float:
        """Modelled grip force in N."""
        return self._model_n

    @property
    def bias_n(self) -> float:
        """Difference between sensor and model in N, as learnt."""
        return self._bias_n

    @property
    def doubt_n(self) -> float:
        """Standard deviation of the bias in N."""
        return sqrt(self._doubt_n2)

    def step(
        self,
        now_s: float,
        dt_s: float,
        setpoint_n: float,
        sample: ForceSample,
        *,
        friction_n: float,
        drive_max_n: float,
        braking_n: float = 0.0,
        motion_n: float = 0.0,
        standing: bool = True,
        taper: bool = False,
        corrected: bool = False,
    ) -> float:
        """Advance by one period and return the driving force in N.

        Parameters
        ----------
        now_s, dt_s
            Monotonic time and time since the last step in s.
        setpoint_n
            Grip force that is asked for now.
        sample
            Newest valid force sample; the same one may come again.
        friction_n
            Half the width of the friction band as grip force.
        drive_max_n
            Largest driving force, from the cap of the current.
        braking_n
            Driving force in N to leave out now, because the fingers are too fast.
        motion_n
            How wrong the model is by the motion of the fingers now, in N.
        standing
            Whether the fingers have stood for a while: then no force grows suddenly.
        taper
            True during a long hold: give back what friction makes superfluous.
        corrected
            True where small errors of a hold are made up for elsewhere.

        Raises
        ------
        LimitExceeded
            When sensor and model disagree by more than is plausible for some time: the sensor
            does not see the force that the current makes. When the sensor jumps to more force than
            the current can make at once.
        """
        held = setpoint_n == self._setpoint_n
        rate_n_s = 0.0
        if self._setpoint_n is not None and dt_s > 0.0:
            rate_n_s = (setpoint_n - self._setpoint_n) / dt_s
        self._learn(
            now_s,
            sample,
            setpoint_n=setpoint_n,
            friction_n=friction_n,
            rate_n_s=abs(rate_n_s),
            motion_n=motion_n,
            standing=standing,
            corrected=corrected,
        )
        if not held:
            self._held_since_s = now_s
        dither_share = self._settings.dither_share
        next_dither = dither_share if self._dither <= 0.0 else -dither_share
        left_alone = held and corrected
        wanted_n = None
        if not left_alone:
            wanted_n = self._edge_n(now_s, setpoint_n, friction_n, rate_n_s=rate_n_s, held=held)
        self._dither = 0.0 if wanted_n is None else next_dither
        if wanted_n is None:
            wanted_n = self._drive_n
            if taper and self._drive_n > self._model_n:
                wanted_n = max(self._model_n, self._drive_n - self._settings.taper_n_s * dt_s)
        wanted_n = self._approached(wanted_n, setpoint_n, friction_n, dt_s)
        self._setpoint_n = setpoint_n
        lowest_n = -self._settings.push_open_share * friction_n
        left_n = max(0.0, drive_max_n - self._drive_n)
        wanted_n = min(wanted_n, self._drive_n + left_n * min(1.0, dt_s / _CAP_TIME_S))
        self._drive_n = min(max(wanted_n, lowest_n), drive_max_n)
        self._move_model(now_s, friction_n)
        crest_n = min(self._dither * friction_n, drive_max_n - self._drive_n)
        return min(self._drive_n - braking_n + crest_n, drive_max_n)

    def follow(
        self,
        now_s: float,
        setpoint_n: float,
        sample: ForceSample,
        *,
        force_n: float,
        doubt_n: float,
        drive_n: float,
        lacking_n: float,
        friction_n: float,
    ) -> None:
        """Take over what another law does while the force rises, so that control can go on here.

        Parameters
        ----------
        now_s
            Monotonic time in s.
        setpoint_n, sample, friction_n
            As for `step`.
        force_n, doubt_n
            Grip force and its standard deviation in N.
        drive_n
            Driving force in N.
        lacking_n
            By how much in N the drive makes less force than the model has it.

        Raises
        ------
        LimitExceeded
            When sensor and model disagree, as in `step`.
        """
        self._history.shift(self._bias_n + lacking_n)
        self._bias_n, self._doubt_n2 = -lacking_n, doubt_n**2
        self._model_n, self._drive_n = force_n + lacking_n, drive_n
        self._history.add(now_s, self._model_n)
        self._setpoint_n, self._rising, self._dither = setpoint_n, True, 0.0
        self._held_since_s = self._breaking_since_s = now_s
        self._sample_s = sample.t_s
        self._check_bias(now_s, sample, setpoint_n, friction_n)

    def _edge_n(
        self, now_s: float, setpoint_n: float, friction_n: float, *, rate_n_s: float, held: bool
    ) -> float | None:
        """Return the drive at the edge of the friction band that moves the force to its target.

        None where the force is near enough: then the drive may stay.
        """
        settings = self._settings
        target_n = setpoint_n - self._bias_n
        if self._rising:
            # An uncertain force is approached from below: the way back is twice the friction.
            target_n -= settings.caution * max(0.0, self.doubt_n - settings.settled_doubt_n)
        error_n = target_n - self._model_n
        reversal_n = max(settings.reversal_band_n, settings.reversal_band_share * setpoint_n)
        band_n = settings.hold_band_n if held else settings.dead_band_n
        # A set-point on its way catches up with the force by itself.
        rise_n = band_n if self._rising else reversal_n + _CATCH_UP_S * max(0.0, -rate_n_s)
        fall_n = band_n if not self._rising else reversal_n + _CATCH_UP_S * max(0.0, rate_n_s)
        if error_n > rise_n:
            target_n += self._bias_n
            self._turn(now_s, rising=True)
            return target_n - self._bias_n + friction_n
        if error_n < -fall_n:
            self._turn(now_s, rising=False)
            return setpoint_n - self._bias_n - friction_n
        return None

    def _approached(
        self, wanted_n: float, setpoint_n: float, friction_n: float, dt_s: float
    ) -> float:
        """Return the drive of this period on the way to the wanted one: fast, then creeping."""
        settings = self._settings
        before_n = setpoint_n if self._setpoint_n is None else self._setpoint_n
        creep_n = settings.creep_n_s * dt_s + _CREEP_PER_RAMP * abs(setpoint_n - before_n)
        fast_n = settings.drive_rate_n_s * dt_s
        inner_n = (1.0 - settings.creep_share) * friction_n
        drive_n = self._drive_n
        if wanted_n > drive_n:
            free_n = max(drive_n, min(drive_n + fast_n, self._model_n + inner_n))
            return min(wanted_n, max(free_n, drive_n + creep_n))
        free_n = min(drive_n, max(drive_n - fast_n, self._model_n - inner_n))
        return max(wanted_n, min(free_n, drive_n - creep_n))

    def _move_model(self, now_s: float, friction_n: float) -> None:
        """Move the modelled force as far as the friction band around the drive pushes it."""
        low_n, high_n = self._drive_n - friction_n, self._drive_n + friction_n
        model_n = min(max(self._model_n, low_n), high_n)
        if model_n < self._model_n:
            self._fell_s = now_s
        if model_n != self._model_n and self._breaking_since_s is not None:
            self._breaking_since_s = None
            self._doubt_n2 += (self._settings.friction_doubt * friction_n) ** 2
        self._model_n = model_n
        self._history.add(now_s, model_n)

    def _turn(self, now_s: float, *, rising: bool) -> None:
        """Turn round at the force that is there: each edge of the band has its own bias."""
        if rising is not self._rising:
            self._edge_bias_n[self._rising] = self._bias_n
            known_n = self._edge_bias_n[rising]
            self._shift_model(self._bias_n - known_n)
            self._bias_n = known_n
            self._rising = rising
            self._breaking_since_s = now_s
            self._breaking.clear()

    def _learn(
        self,
        now_s: float,
        sample: ForceSample,
        *,
        setpoint_n: float,
        friction_n: float,
        rate_n_s: float,
        motion_n: float,
        standing: bool,
        corrected: bool,
    ) -> None:
        """Correct the bias by the newest sample, and refuse one that cannot be.

        A step of a Kalman filter for the bias: the doubt grows with time, friction and motion, and
        each sample lowers it.
        """
        settings = self._settings
        seen_n = sample.grip_n - self._history.at(sample.measured_s)
        fell = now_s - self._fell_s < _AFTER_FALL_S
        jumped = standing and self.jumps(
            sample, seen_n - self._bias_n, setpoint_n, friction_n, fell=fell
        )
        if sample.t_s > self._sample_s and not jumped:
            step_s = sample.t_s - self._sample_s
            drift_n_rs = settings.bias_drift_n_rs * (1.0 + rate_n_s / settings.bias_rate_n_s)
            # At rest the mean goes back farther and farther, lest noise ratchets the force up.
            lasts_s = now_s - self._held_since_s - (_CREEP_S if corrected else 0.0)
            drift_n_rs /= 1.0 + min(max(lasts_s, 0.0) / _LONGER_EACH_S, _LONGEST_MEAN)
            self._doubt_n2 += drift_n_rs**2 * step_s
            noise_n2 = sample.noise_n**2 + motion_n**2 * _MOTION_S / step_s
            gain = self._doubt_n2 / (self._doubt_n2 + noise_n2)
            self._doubt_n2 *= 1.0 - gain
            self._sample_s = sample.t_s
            self._bias_n += gain * (seen_n - self._bias_n)
            since_s = self._breaking_since_s
            if not self._rising and since_s is not None and sample.t_s > since_s:
                self._anchor(sample, setpoint_n, friction_n)
        self._check_bias(now_s, sample, setpoint_n, friction_n)

    def jumps(
        self,
        sample: ForceSample,
        jump_n: float,
        setpoint_n: float,
        friction_n: float,
        *,
        fell: bool = False,
    ) -> bool:
        """Return whether a sample shows far more force than before though no drive made it.

        Following it would let a part go whose force has not changed.

        Parameters
        ----------
        sample
            Newest valid force sample; the same one may come again.
        jump_n
            What it shows beyond the force that the drive explains, in N.
        setpoint_n
            Grip force that is asked for in N.
        friction_n
            Half the width of the friction band as grip force.
        fell
            Whether the modelled force has just fallen: friction may still hold more.

        Raises
        ------
        LimitExceeded
            When it lasts.
        """
        least_n = max(_JUMP_N, _JUMP_SHARE * setpoint_n, _JUMP_FRICTION_SHARE * friction_n)
        least_n += _JUMP_SIGMAS * sample.noise_n
        if fell:
            least_n += _STICKS_SHARE * friction_n
        if jump_n <= least_n:
            self._jumped_s = None
            return False
        if self._jumped_s is None:
            self._jumped_s = sample.t_s
        if sample.t_s - self._jumped_s >= _JUMP_S:
            raise LimitExceeded(
                f"the pads report {jump_n:.2f} N more than before on a part that is pressed as "
                f"before, {least_n:.2f} N are allowed: their zero has jumped, or something pushes "
                f"the fingers together. The goals are frozen and the grip kept: check the pads, "
                f"then clear the fault and release"
            )
        return True

    def _check_bias(
        self, now_s: float, sample: ForceSample, setpoint_n: float, friction_n: float
    ) -> None:
        """Raise LimitExceeded when the bias has been larger than plausible for some time."""
        settings = self._settings
        limit_n = (
            settings.bias_max_n
            + settings.bias_max_share * setpoint_n
            + settings.bias_max_friction_share * friction_n
        )
        if abs(self._bias_n) <= limit_n:
            self._implausible_since_s = None
        elif self._implausible_since_s is None:
            self._implausible_since_s = now_s
        elif now_s - self._implausible_since_s > _IMPLAUSIBLE_S:
            raise LimitExceeded(
                f"force sensor and servo current disagree by {self._bias_n:.2f} N, more than "
                f"{limit_n:.2f} N: the sensor reads {sample.grip_n:.2f} N where the current makes "
                f"{self._model_n:.2f} N. Check the pads, the tare and the torque figures"
            )

    def _anchor(self, sample: ForceSample, setpoint_n: float, friction_n: float) -> None:
        """On the way down, take the present drive for the band's edge when the force gets there.

        Friction smaller than the model's lets the force fall although the model still waits for
        the edge; then the sensor shows where the edge was.
        """
        breaking = self._breaking
        breaking.append((sample.t_s, sample.grip_n))
        while len(breaking) > 2 and sample.t_s - breaking[1][0] >= _ANCHOR_S:
            breaking.popleft()
        mean_n = sum(grip_n for _, grip_n in breaking) / len(breaking)
        inside = self._model_n - self._drive_n < (1.0 - self._settings.creep_share) * friction_n
        if sample.t_s - breaking[0][0] < _ANCHOR_S or mean_n > setpoint_n or inside:
            return
        model_n = self._drive_n + friction_n
        self._shift_model(model_n - self._model_n)
        self._bias_n = mean_n - model_n
        self._breaking_since_s = None

    def _shift_model(self, shift_n: float) -> None:
        """Correct the modelled force, now and in its history."""
        self._history.shift(shift_n)
        self._model_n += shift_n


class SetpointFilter:
    """Filter of the set-point that slows down before the end of a change of force.

    The moving masses and the part are a swing with little damping: where the rate of the force
    ends with a knee, the force runs on. The filtered set-point is never beyond the set-point and
    never faster; its rate is at most the force that is left over ``end_time_s``.

    Parameters
    ----------
    force_n
        Force at the beginning in N.
    end_time_s
        Time constant of the arrival in s; 0 follows the set-point itself.
    """

    def __init__(self, force_n: float, end_time_s: float) -> None:
        self._end_time_s = end_time_s
        self.force_n = force_n
        self.rate_n_s = 0.0

    def step(self, dt_s: float, setpoint_n: float, end_n: float) -> float:
        """Advance by ``dt_s`` s and return the force in N.

        Parameters
        ----------
        dt_s
            Time since the last step in s.
        setpoint_n
            Set-point of the ramp now in N.
        end_n
            Force in N at which the present change of force ends.
        """
        left_n = end_n - self.force_n
        if self._end_time_s <= 0.0 or abs(left_n) <= _ARRIVED_N:
            force_n = setpoint_n
        else:
            share = min(1.0, dt_s / self._end_time_s)
            limit_n = self.force_n + left_n * share
            force_n = min(setpoint_n, limit_n) if left_n > 0.0 else max(setpoint_n, limit_n)
        self.rate_n_s = (force_n - self.force_n) / dt_s if dt_s > 0.0 else 0.0
        self.force_n = force_n
        return force_n


class History:
    """Values of the last periods by time."""

    def __init__(self) -> None:
        self._entries: deque[tuple[float, float]] = deque(maxlen=_HISTORY_LENGTH)

    def add(self, now_s: float, value: float) -> None:
        """Add the value of now."""
        self._entries.append((now_s, value))

    @property
    def newest(self) -> float:
        """The value that was added last."""
        return self._entries[-1][1]

    def at(self, t_s: float) -> float:
        """Return the value at a time in s; the oldest one where the time is before it."""
        for then_s, value in reversed(self._entries):
            if then_s <= t_s:
                return value
        return self._entries[0][1]

    def shift(self, by: float) -> None:
        """Add ``by`` to all values."""
        self._entries = deque(
            ((then_s, value + by) for then_s, value in self._entries), maxlen=_HISTORY_LENGTH
        )
