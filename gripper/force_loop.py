"""Force loop: from the set-point of the grip force to the driving force of the fingers.

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
from gripper.force import ForceSample
from gripper.settings import ForceLoopSettings

_HISTORY_LENGTH = 128
_IMPLAUSIBLE_S = 0.3
_ANCHOR_SAMPLES = 3
_CATCH_UP_S = 0.2
_LONGEST_MEAN = 5.0


class ForceLoop:
    """State of the force loop of one grasp; no clock, no bus.

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
        self._breaking: list[float] = []
        self._dither = 0.0
        self._bias_n = 0.0
        self._edge_bias_n = {True: 0.0, False: 0.0}
        self._doubt_n2 = settings.start_doubt_n**2
        self._history: deque[tuple[float, float]] = deque(maxlen=_HISTORY_LENGTH)
        self._history.append((now_s, force_n))
        self._sample_s = now_s
        self._held_since_s = now_s
        self._implausible_since_s: float | None = None

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
        """Learnt difference between sensor and model in N."""
        return self._bias_n

    @property
    def doubt_n(self) -> float:
        """Standard deviation in N of what has been learnt."""
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
        taper: bool = False,
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
        taper
            True during a long hold: give back what friction makes superfluous.

        Raises
        ------
        LimitExceeded
            When sensor and model disagree by more than is plausible for some time: the sensor
            does not see the force that the current makes.
        """
        settings = self._settings
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
        )
        target_n = setpoint_n - self._bias_n
        if self._rising:
            # What is not known well is approached from below: the way back is twice the friction.
            target_n -= settings.caution * max(0.0, self.doubt_n - settings.settled_doubt_n)
        error_n = target_n - self._model_n
        reversal_n = max(settings.reversal_band_n, settings.reversal_band_share * setpoint_n)
        held = setpoint_n == self._setpoint_n
        if not held:
            self._held_since_s = now_s
        band_n = settings.hold_band_n if held else settings.dead_band_n
        # A set-point on its way catches up with the force by itself.
        rise_n = band_n if self._rising else reversal_n + _CATCH_UP_S * max(0.0, -rate_n_s)
        fall_n = band_n if not self._rising else reversal_n + _CATCH_UP_S * max(0.0, rate_n_s)
        wanted_n = self._drive_n
        dither = settings.dither_share if self._dither <= 0.0 else -settings.dither_share
        self._dither = 0.0
        if error_n > rise_n:
            self._dither = dither
            target_n += self._bias_n
            self._turn(now_s, rising=True)
            wanted_n = target_n - self._bias_n + friction_n
        elif error_n < -fall_n:
            self._dither = dither
            self._turn(now_s, rising=False)
            wanted_n = setpoint_n - self._bias_n - friction_n
        elif taper and self._drive_n > self._model_n:
            wanted_n = max(self._model_n, self._drive_n - settings.taper_n_s * dt_s)
        wanted_n = self._approached(wanted_n, setpoint_n, friction_n, dt_s)
        self._drive_n = min(max(wanted_n, -settings.push_open_share * friction_n), drive_max_n)
        applied_n = self._drive_n - braking_n
        low_n, high_n = self._drive_n - friction_n, self._drive_n + friction_n
        model_n = min(max(self._model_n, low_n), high_n)
        if model_n != self._model_n and self._breaking_since_s is not None:
            self._breaking_since_s = None
            self._doubt_n2 += (settings.friction_doubt * friction_n) ** 2
        self._model_n = model_n
        self._history.append((now_s, self._model_n))
        return min(applied_n + self._dither * friction_n, drive_max_n)

    def _approached(
        self, wanted_n: float, setpoint_n: float, friction_n: float, dt_s: float
    ) -> float:
        """Return the drive of this period on the way to the wanted one: fast, then creeping."""
        settings = self._settings
        before_n = setpoint_n if self._setpoint_n is None else self._setpoint_n
        self._setpoint_n = setpoint_n
        creep_n = settings.creep_n_s * dt_s + 1.5 * abs(setpoint_n - before_n)
        fast_n = settings.drive_rate_n_s * dt_s
        inner_n = (1.0 - settings.creep_share) * friction_n
        drive_n = self._drive_n
        if wanted_n > drive_n:
            free_n = max(drive_n, min(drive_n + fast_n, self._model_n + inner_n))
            return min(wanted_n, max(free_n, drive_n + creep_n))
        free_n = min(drive_n, max(drive_n - fast_n, self._model_n - inner_n))
        return max(wanted_n, min(free_n, drive_n - creep_n))

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
    ) -> None:
        settings = self._settings
        if sample.t_s > self._sample_s:
            step_s = sample.t_s - self._sample_s
            share = step_s / settings.bias_time_s * (1.0 + rate_n_s / settings.bias_rate_n_s)
            # At rest the mean goes back farther and farther, lest noise ratchets the force up.
            share /= 1.0 + min((now_s - self._held_since_s) / settings.bias_time_s, _LONGEST_MEAN)
            noise_n2 = settings.sample_noise_n**2
            self._doubt_n2 += noise_n2 * share * share
            gain = self._doubt_n2 / (self._doubt_n2 + noise_n2 + motion_n * motion_n)
            self._doubt_n2 *= 1.0 - gain
            self._sample_s = sample.t_s
            seen_n = sample.grip_n - self._model_at(sample.t_s - settings.sensor_delay_s)
            self._bias_n += gain * (seen_n - self._bias_n)
            since_s = self._breaking_since_s
            if not self._rising and since_s is not None and sample.t_s > since_s:
                self._anchor(sample.grip_n, setpoint_n, friction_n)
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

    def _anchor(self, grip_n: float, setpoint_n: float, friction_n: float) -> None:
        """On the way down, take the present drive for the band's edge when the force gets there.

        Friction smaller than the model's lets the force fall although the model still waits for
        the edge; then the sensor says where the edge was.
        """
        self._breaking = [*self._breaking, grip_n][-_ANCHOR_SAMPLES:]
        mean_n = sum(self._breaking) / len(self._breaking)
        inside = self._model_n - self._drive_n < (1.0 - self._settings.creep_share) * friction_n
        if len(self._breaking) < _ANCHOR_SAMPLES or mean_n > setpoint_n or inside:
            return
        model_n = self._drive_n + friction_n
        self._shift_model(model_n - self._model_n)
        self._bias_n = mean_n - model_n
        self._breaking_since_s = None

    def _shift_model(self, shift_n: float) -> None:
        """Correct the modelled force, now and in what is remembered of it."""
        self._history = deque(
            ((then_s, then_n + shift_n) for then_s, then_n in self._history),
            maxlen=_HISTORY_LENGTH,
        )
        self._model_n += shift_n

    def _model_at(self, t_s: float) -> float:
        """Return the modelled force in N at an earlier time, as far back as it is known."""
        for then_s, model_n in reversed(self._history):
            if then_s <= t_s:
                return model_n
        return self._history[0][1]
