"""Observer of fingers that press on a part: force, speed, drive error, stiffness.

Motor and finger, seen at the pad, are a mass. Friction brakes it, and a spring, pad and part,
pushes back.
"""

from math import exp, log, sqrt

from gripper.force.estimates.grip import Grip
from gripper.force.estimates.history import History
from gripper.force.estimates.stiffness import STIFFEST_N_M
from gripper.force.loop import Moment
from gripper.servos.goal_limits import STICTION
from gripper.values.force_sensor import ForceSample

_SOFTEST_N_M = 100.0
"""Least stiffness in N/m of pad and part at one pad. [chosen]"""
LOG_STIFFNESS_SD, _LOG_STIFFNESS_RS = 0.5, 2.0
"""Initial standard deviation of the logarithm of the stiffness, and its random walk per root of a
second: foam hardens. [tuned]"""
_PAD_N_M = 4e3
"""Stiffness in N/m of a usual pad with little load: less needs evidence. [tuned]"""
_EXPECTED_N, _SHORT_SHARE = 0.15, 0.25
"""Least expected growth in N for this evidence, and the share of it that samples must lack; both
are sums over the samples of a motion. [tuned]"""
_DISTURBANCE_SHARE, _DISTURBANCE_N_RS = 0.12, 1.5
"""Initial uncertainty of drive and friction, as a share of the drive, and random walk of their
difference in N per root of a second. [tuned]"""
_DISTURBANCE_N_RM = 200.0
"""The same for each m/s of speed: friction changes with the speed. [tuned]"""
_SPEED_NOISE_M_S = 0.0007
"""Noise in m/s of the speed by the servos: half of its resolution of 1.4 mm/s. [resolution]"""
_SPEED_WANDER_M_S, _FORCE_WANDER_N = 0.0004, 0.02
"""Random change of speed in m/s and force in N in a period: ripple and creep. [tuned]"""
_BELIEVED_SDS, _BELIEVED_N = 3.0, 0.2
"""Deviations of a sample that are corrected at once, and their least value in N. A larger jump is
an error of the pads or a slipping part, and supervision ends the ramp. [tuned]"""
_EDGE_DOUBT_N = 0.2
"""Uncertainty in N of the edge of the friction at which slowly pushed fingers start to move.
[tuned]"""


class ContactObserver:
    """Kalman filter of force, speed, drive and stiffness of fingers that press on a part.

    The state is force in N, closing speed of a pad in m/s, missing force of the drive in N, and the
    logarithm of the stiffness at one pad in N/m.

    Parameters
    ----------
    grip
        State of the grip at the start.
    start_s
        Monotonic time in s.
    stiffness_n_m, lacking_n
        Stiffness at one pad in N/m and missing force of the drive in N, as far as they are known.
    log_stiffness_sd
        Standard deviation of the logarithm of the stiffness.
    """

    def __init__(
        self,
        grip: Grip,
        start_s: float,
        *,
        stiffness_n_m: float,
        lacking_n: float,
        log_stiffness_sd: float = LOG_STIFFNESS_SD,
    ) -> None:
        self.mass_kg = grip.mass_kg
        self.force_n = max(0.0, grip.estimate.force_n)
        self.speed_m_s = 0.0
        self.lacking_n = lacking_n
        self._log_stiffness = log(min(max(stiffness_n_m, _SOFTEST_N_M), STIFFEST_N_M))
        self._p = [
            [grip.estimate.doubt_n**2, 0.0, 0.0, 0.0],
            [0.0, _SPEED_NOISE_M_S**2, 0.0, 0.0],
            [0.0, 0.0, (_DISTURBANCE_SHARE * max(grip.drive_n, 1.0)) ** 2, 0.0],
            [0.0, 0.0, 0.0, log_stiffness_sd**2],
        ]
        self._history = History()
        self._history.add(start_s, self.force_n)
        self._sample_s = start_s
        self._start_n = self.force_n
        self._expected_n = self._short_n = 0.0
        self._soft = False
        self._learnt: tuple[float, bool] | None = None

    @property
    def stiffness_n_m(self) -> float:
        """Stiffness at one pad in N/m."""
        return exp(self._log_stiffness)

    @property
    def doubt_n(self) -> float:
        """Standard deviation of the force in N."""
        return sqrt(max(self._p[0][0], 0.0))

    def speed_after_m_s(
        self, dt_s: float, drive_n: float, frictions_n: tuple[float, float]
    ) -> float:
        """Return the speed in m/s after ``dt_s`` s under a drive; 0 where friction locks.

        ``frictions_n``: friction in N while the fingers close, and while they open.
        """
        push_n, (closing_n, opening_n) = drive_n - self.lacking_n - self.force_n, frictions_n
        speed = self.speed_m_s
        braked_n = push_n - (closing_n if speed >= 0.0 else -opening_n)
        after = speed + braked_n * dt_s / self.mass_kg
        if speed * after > 0.0:
            return after
        if -STICTION * opening_n <= push_n <= STICTION * closing_n:
            return 0.0
        return (push_n - (closing_n if push_n > 0.0 else -opening_n)) * dt_s / self.mass_kg

    def step(
        self,
        moment: Moment,
        *,
        drive_n: float,
        frictions_n: tuple[float, float],
        sample: ForceSample | None,
    ) -> None:
        """Advance to the present feedback and use it.

        Parameters
        ----------
        moment
            Feedback.
        drive_n
            Driving force in N since the last step, by the measured currents.
        frictions_n
            As `speed_after_m_s`.
        sample
            Newest valid force sample, which may be the same as before; None leaves it out.
        """
        if moment.dt_s > 0.0:
            self._predict(moment.dt_s, drive_n, frictions_n)
        speed_m_s = -0.5 * moment.state.aperture_velocity_m_s
        self._history.add(moment.now_s, self.force_n)
        self._correct(1, speed_m_s - self.speed_m_s, _SPEED_NOISE_M_S**2)
        if sample is not None and sample.t_s > self._sample_s:
            self._sample_s = sample.t_s
            most_n = max(_BELIEVED_N, _BELIEVED_SDS * sqrt(self._p[0][0] + sample.noise_n**2))
            unexplained_n = self.unexplained_n(sample)
            self._expected_n += sample.grip_n - unexplained_n - self._start_n
            self._short_n -= unexplained_n
            error_n = min(max(unexplained_n, -most_n), most_n)
            before_n = self.force_n
            self._correct(0, error_n, sample.noise_n**2)
            self._history.shift(self.force_n - before_n)

    def learn_stiffness(self, stiffness_n_m: float, log_sd: float) -> None:
        """Use a stiffness at one pad in N/m that the way of the fingers has shown.

        Pads that show a force before they touch make a stiff part look soft. So a stiffness below
        that of usual pads counts only if the force has grown less than expected in this motion.

        Parameters
        ----------
        stiffness_n_m, log_sd
            Stiffness, and standard deviation of its logarithm. The same stiffness counts once.
        """
        least_n = _SHORT_SHARE * self._expected_n
        self._soft |= self._expected_n > _EXPECTED_N and self._short_n > least_n
        if (stiffness_n_m, self._soft) == self._learnt:
            return
        self._learnt = stiffness_n_m, self._soft
        if not self._soft:
            stiffness_n_m = max(stiffness_n_m, min(_PAD_N_M, self.stiffness_n_m))
        self._correct(3, log(stiffness_n_m) - self._log_stiffness, log_sd**2)

    def open_from(self, drive_n: float, friction_n: float) -> None:
        """Set the edge of the friction from the drive in N at which fingers started to open.

        Fingers that started later than expected give no new edge.
        """
        edge_n = drive_n - self.force_n + STICTION * friction_n
        if edge_n <= self.lacking_n:
            return
        self.lacking_n = edge_n
        for other in range(4):
            self._p[2][other] = self._p[other][2] = 0.0
        self._p[2][2] = _EDGE_DOUBT_N**2

    def unexplained_n(self, sample: ForceSample) -> float:
        """Return the excess in N of a sample over the force at the time of its measurement."""
        return sample.grip_n - self._history.at(sample.measured_s)

    def _predict(self, dt_s: float, drive_n: float, frictions_n: tuple[float, float]) -> None:
        stiffness, mass = self.stiffness_n_m, self.mass_kg
        speed = self.speed_m_s
        after = self.speed_after_m_s(dt_s, drive_n, frictions_n)
        self.force_n = max(0.0, self.force_n + 0.5 * (speed + after) * stiffness * dt_s)
        self.speed_m_s = after
        p = self._p
        if after == 0.0:
            # A locked mass gives no information on drive and stiffness.
            for one in range(4):
                for other in range(4):
                    if one != other:
                        p[one][other] = 0.0
            p[1][1] = _SPEED_WANDER_M_S**2
        else:
            way = stiffness * dt_s
            f = (
                (1.0, way, 0.0, 0.5 * (speed + after) * way),
                (-dt_s / mass, 1.0, -dt_s / mass, 0.0),
                (0.0, 0.0, 1.0, 0.0),
                (0.0, 0.0, 0.0, 1.0),
            )
            fp = [[sum(f[i][k] * p[k][j] for k in range(4)) for j in range(4)] for i in range(4)]
            self._p = p = [
                [sum(fp[i][k] * f[j][k] for k in range(4)) for j in range(4)] for i in range(4)
            ]
            p[1][1] += _SPEED_WANDER_M_S**2
            p[2][2] += (_DISTURBANCE_N_RS**2 + (_DISTURBANCE_N_RM * after) ** 2) * dt_s
            p[3][3] += _LOG_STIFFNESS_RS**2 * dt_s
        p[0][0] += _FORCE_WANDER_N**2

    def _correct(self, of: int, error: float, noise2: float) -> None:
        """Correct the state by one of its measured entries."""
        p = self._p
        gains = [p[row][of] / (p[of][of] + noise2) for row in range(4)]
        self.force_n += gains[0] * error
        self.speed_m_s += gains[1] * error
        self.lacking_n += gains[2] * error
        self._log_stiffness = min(
            max(self._log_stiffness + gains[3] * error, log(_SOFTEST_N_M)), log(STIFFEST_N_M)
        )
        row = list(p[of])
        for i in range(4):
            for j in range(4):
                p[i][j] -= gains[i] * row[j]
