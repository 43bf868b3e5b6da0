"""Disturbance observer of fingers on a part: force, speed, missing drive and way.

Motor and finger, seen at the pad, are a mass m. Coulomb friction phi brakes it, and a spring k, pad
and part, pushes back. With the drive u, the torque of the measured currents as a force at the pad:

    F' = k v,    m v' = u - d - F - phi sign(v),    d' = 0,    x' = v

d is the force that the drive lacks. A Kalman filter with this model is the observer (Ohnishi,
Shibata and Murakami 1996, reaction force observer). It uses the positions of the servos
and the force samples of the pads, each with its own noise. A sample is compared with the force at
the time of its measurement, so its delay has no effect. Rare samples are the same with larger steps
between them. A period may be longer than the swing of a stiff part. So the trapezoidal rule
integrates the model: it is stable with any step.

The stiffness is that of the samples and positions since the touch, within its bounds
(`StiffnessEstimate`). A count of the position is often more than a stiff part yields, so a wrong
stiffness turns each count into a wrong force. The filter considers its uncertainty, but does not
correct it (Schmidt 1966): of noise it would learn a stiffness that is far too high, and then
trust the force of each count.

Where friction locks the mass, v is 0 and nothing is learnt of d (Karnopp 1985, stick and slip).

A measurement may be wrong for some readings. A current that does not follow its goal makes v
uncertain. A position that leaps farther than drive and force can move the mass is no way
(Bar-Shalom, Li and Kirubarajan 2001, validation gate): it makes F uncertain, and the next samples
show the force.
"""

from math import inf, log, sqrt

import numpy as np
from numpy.typing import NDArray

from gripper.force.certainty import SURE_SDS
from gripper.force.estimates.grip import Grip, History
from gripper.force.loop import Moment
from gripper.mechanics.impact import impact_limit
from gripper.values.force_sensor import FRAME_S, ForceSample

_START_SD_N, _MISSING_SD_N = 0.3, 0.2
"""Standard deviations in N of the force and of the missing drive at the start. [chosen]"""
_CREEP_N = 0.02
"""Random change of the force in N in a period: foam creeps by 7 % in a second. [assumed]"""
_RIPPLE_M_S = 0.0004
"""Random change of the speed in m/s in a period: noise of the current, 7 mA. [log]"""
_MISSING_N_RS, _MISSING_N_RM = 1.0, 200.0
"""Random walk of the missing drive in N per root of a second, and the same for each m/s: friction
changes with place and speed. [chosen]"""
_LEAST_LOG_SD = 0.3
"""Least standard deviation of ln k, because foam hardens. [chosen]"""
_IDENTITY = np.eye(5)
_WAY = _IDENTITY[3]
"""Derivative of a measured way by the state."""


class GripObserver:
    """Observer of one grip.

    Parameters
    ----------
    grip
        State of the grip; its force is that at the start.
    now_s
        Monotonic time in s.
    """

    def __init__(self, grip: Grip, now_s: float) -> None:
        self.mass_kg = impact_limit(grip.mechanics).mass_kg
        """Moving mass of a finger at the pad in kg."""
        self._estimate = grip.stiffness
        self.force_n = max(0.0, grip.force_n)
        """Grip force in N."""
        self.speed_m_s = 0.0
        """Closing speed of a pad in m/s; 0 where friction locks the fingers."""
        self._breaks = False
        self.missing_n = 0.0
        """Missing force of the drive in N."""
        self._way_m, self._start_m = 0.0, grip.stiffness.apertures.newest
        # Rounding and a dither of one step: a third of its square is the variance of a position.
        way_sd_m = 0.5 * grip.stiffness.step_m * sqrt(len(grip.settings.servos) / 3.0)
        self._way_m2 = way_sd_m**2
        self._p = np.diag((_START_SD_N, 0.0, _MISSING_SD_N, way_sd_m, 1.0)) ** 2
        self._take_stiffness()
        self._forces, self._ways_m = History(), History()
        self._forces.add(now_s, self.force_n)
        self._ways_m.add(now_s, 0.0)
        self._sample_s, self._period_s, self._leapt_s = now_s, now_s, -inf
        self._unsure_m = 0.0

    @property
    def force_sd_n(self) -> float:
        """Standard deviation of the force in N."""
        return sqrt(max(float(self._p[0, 0]), 0.0))

    def meets_stiffness(self, change_n: float) -> None:
        """Allow for a stiffer part, whose force has changed by N more than the model explains."""
        self.resume(change_n)
        self._estimate.allow_harder()
        self._take_stiffness()

    def resume(self, change_n: float = _START_SD_N) -> None:
        """Allow for a change of the force in N that the model does not have, as after a pause."""
        self._p[0, 0] += change_n**2

    def begin_period(self, now_s: float) -> None:
        """Begin a period at a time in s; in a pause before it the fingers came to rest."""
        paused, self._period_s = now_s - self._period_s > FRAME_S, now_s
        if paused:
            self.speed_m_s, self._breaks = 0.0, False
            # Samples of the pause belong to the present force and way, not to those before it.
            self._forces, self._ways_m = History(), History()

    def break_loose(self, speed_m_s: float) -> None:
        """Set the speed after a push on locked fingers; 0 if they stay locked.

        ``speed_m_s``: speed that they then have at the end of its period.
        """
        self.speed_m_s = speed_m_s
        self._p[1, 1] += speed_m_s**2
        self._breaks = True

    def speed_after_m_s(
        self, dt_s: float, drive_n: float, frictions_n: tuple[float, float]
    ) -> float:
        """Return the speed in m/s after ``dt_s`` s under a drive; 0 where friction locks.

        ``frictions_n``: friction in N while the fingers close, and while they open.
        """
        if self.speed_m_s == 0.0:
            return 0.0
        push_n, (closing_n, opening_n) = drive_n - self.missing_n - self.force_n, frictions_n
        braked_n = push_n - (closing_n if self.speed_m_s > 0.0 else -opening_n)
        share, gain_m_s_n = self._step(dt_s)
        after_m_s = share * self.speed_m_s + gain_m_s_n * braked_n
        return after_m_s if after_m_s * self.speed_m_s > 0.0 else 0.0

    def _step(self, dt_s: float) -> tuple[float, float]:
        """Return the share of the speed that is left after a step, and its change in m/s per N."""
        swing = 0.25 * self.stiffness_n_m * dt_s**2 / self.mass_kg
        return (1.0 - swing) / (1.0 + swing), dt_s / self.mass_kg / (1.0 + swing)

    def predict(
        self, dt_s: float, drive_n: float, drive_sd_n: float, frictions_n: tuple[float, float]
    ) -> None:
        """Advance by ``dt_s`` s under a drive and its standard deviation in N.

        ``frictions_n``: as `speed_after_m_s`.
        """
        stiffness, before_m_s = self.stiffness_n_m, self.speed_m_s
        # The model of a moving mass may be wrong by as much as drive and force move it.
        moves_n = abs(drive_n) + self.force_n if before_m_s != 0.0 else 0.0
        self._unsure_m = moves_n / self.mass_kg * dt_s**2
        if self._breaks:
            self._breaks, before_m_s = False, 0.0
        else:
            self.speed_m_s = self.speed_after_m_s(dt_s, drive_n, frictions_n)
        way_m = 0.5 * (before_m_s + self.speed_m_s) * dt_s
        self.force_n = max(0.0, self.force_n + stiffness * way_m)
        self._way_m += way_m
        if before_m_s != 0.0 or self.speed_m_s != 0.0:
            f, (share, gain_m_s_n) = _IDENTITY.copy(), self._step(dt_s)
            f[1] = -gain_m_s_n, share, -gain_m_s_n, 0.0, 0.0
            way = 0.5 * dt_s * np.array((-gain_m_s_n, 1.0 + share, -gain_m_s_n, 0.0, 0.0))
            f[0] += stiffness * way
            f[0, 4] = stiffness * way_m
            f[3] += way
            self._p = f @ self._p @ f.T
            self._p[1, 1] += _RIPPLE_M_S**2 + (gain_m_s_n * drive_sd_n) ** 2
            self._p[2, 2] += (_MISSING_N_RS**2 + (_MISSING_N_RM * self.speed_m_s) ** 2) * dt_s
        if self.speed_m_s == 0.0:
            self._p[1], self._p[:, 1] = 0.0, 0.0
        self._p[0, 0] += _CREEP_N**2

    def measure(self, moment: Moment, sample: ForceSample | None) -> None:
        """Use the present position, and the newest sample where it is new."""
        error_m = 0.5 * (self._start_m - moment.state.aperture_m) - self._way_m
        way_sd_m = sqrt(self._p[3, 3] + self._way_m2) + self._unsure_m
        if abs(error_m) > SURE_SDS * way_sd_m:
            self._start_m -= 2.0 * error_m
            self.resume(self.stiffness_n_m * error_m)
            error_m, self._leapt_s = 0.0, moment.now_s
        before_m = self._way_m
        self._correct(_WAY, error_m, self._way_m2)
        # The force has followed the way by the stiffness, with its uncertainty.
        followed_n = self.stiffness_n_m * (self._way_m - before_m)
        self._p[0] += followed_n * self._p[4]
        self._p[:, 0] += followed_n * self._p[:, 4]
        self._forces.add(moment.now_s, self.force_n)
        self._ways_m.add(moment.now_s, self._way_m)
        if sample and sample.t_s > self._sample_s and sample.measured_s > self._leapt_s:
            self._sample_s, before_n = sample.t_s, self.force_n
            # The force at that time is the present one without the way since then.
            since_n = self.stiffness_n_m * (self._way_m - self._ways_m.at(sample.measured_s))
            of = np.array((1.0, 0.0, 0.0, 0.0, -since_n))
            # A sensor is read once in a period: the time of a sample is known to one of them.
            change_n = self.stiffness_n_m * self.speed_m_s * moment.dt_s
            self._correct(of, self.unexplained_n(sample), sample.noise_n**2 + change_n**2 / 12.0)
            self._forces.shift(self.force_n - before_n)
            self._take_stiffness()

    def unexplained_n(self, sample: ForceSample) -> float:
        """Return the excess in N of a sample over the force at the time of its measurement."""
        return sample.grip_n - self._forces.at(sample.measured_s)

    def _correct(self, of: NDArray[np.float64], error: float, noise2: float) -> None:
        """Correct the state by a measurement, whose derivatives by the state are ``of``."""
        p_of = self._p @ of
        gains = p_of / (of @ p_of + noise2)
        gains[4] = 0.0
        force_n, speed_m_s, missing_n, way_m, _ = (gains * error).tolist()
        self.force_n = max(0.0, self.force_n + force_n)
        self.speed_m_s += speed_m_s
        self.missing_n += missing_n
        self._way_m += way_m
        left = _IDENTITY - gains[:, None] * of
        self._p = left @ self._p @ left.T + noise2 * (gains[:, None] * gains)

    def _take_stiffness(self) -> None:
        """Take the middle of the bounds of the stiffness, and their width as its uncertainty."""
        least_n_m, most_n_m = self._estimate.bounds_n_m
        self.stiffness_n_m = 2.0 * sqrt(least_n_m * most_n_m)
        """Stiffness of part and pad, at one pad, in N/m."""
        log_sd = max(_LEAST_LOG_SD, log(most_n_m / least_n_m) / sqrt(12.0))
        # What is not known of the next travel has not acted on the force yet.
        share = min(1.0, log_sd / sqrt(self._p[4, 4]))
        self._p[4] *= share
        self._p[:, 4] *= share
        self._p[4, 4] = log_sd**2
