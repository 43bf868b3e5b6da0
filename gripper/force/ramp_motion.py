"""Motion of the fingers that changes the grip force as planned, and the observer it goes by.

Motor and finger, seen at the pad, are a mass that friction brakes and a spring, pad and part,
pushes back. A fast ramp is a motion of that mass: force and speed follow a plan whose rate has no
corner, what the mass needs for it is fed forward, and so are friction and the stiffness of the
part, which is learnt in each contact. At the end the mass is at rest, and friction locks it.
"""

from collections import deque
from math import copysign, exp, log, sqrt

from gripper.force.controller import History
from gripper.force_sensor import ForceSample
from gripper.servos.goals import STICTION

# Figures without another source are tuned in the simulated cell, with friction up to 20 % off.
_CURRENT_S, _WRITE_S = 0.003, 0.001
"""Time constant in s of a servo's current (assumed), and time in s from the feedback of a period to
the write of its goals."""
_SOFTEST_N_M, _STIFFEST_N_M = 100.0, 1e5
"""Range of the stiffness in N/m of pad and part at one pad."""
_LOG_STIFFNESS_SD, _LOG_STIFFNESS_RS = 0.5, 2.0
"""How uncertain the logarithm of the stiffness is at first, and how fast it wanders, per root of a
second: foam hardens."""
_DISTURBANCE_SHARE, _DISTURBANCE_N_RS = 0.12, 1.5
"""How uncertain drive and friction are at first, as a share of the drive, and how fast the
difference wanders, in N per root of a second."""
_SPEED_NOISE_M_S = 0.0007
"""Noise in m/s of the speed that the servos report: half of its grain of 1.4 mm/s."""
_SPEED_WANDER_M_S, _FORCE_WANDER_N = 0.0004, 0.02
"""What a period adds by itself to speed in m/s and force in N: ripple and creep."""
_BELIEVED_SDS, _BELIEVED_N = 3.0, 0.2
"""Deviations of a sample that are made up for at once, and at least so many N: pads that jump by
more lie, or a part slips, and what watches over them ends the ramp."""
_RATE_S = 0.025
"""Time in s in which the rate of a plan gets to that of its ramp, and back to 0."""
_INERTIA_N = 2.0
"""Force in N that the mass may need for a plan: a soft part makes it slower."""
_FORCE_S, _SPEED_S = 0.04, 0.012
"""Time constants in s with which an error of force and of speed are made up for."""
_LATE_S = 0.3
"""Time in s after the end of its ramp at which a motion is given up: something else is wrong."""
_LEAST_RATE_N_S = 5.0
"""Rate in N/s that the plan of a small correction has in mind."""
_LOCKED_SHARE = 0.5
"""Share of the friction beyond the force at which the drive stays: friction locks the fingers."""
_BREAKAWAY_N = 0.1
"""Drive in N beyond friction at rest with which locked fingers are set in motion."""
_LOOSENED_SHARE, _LOOSENING_N_S = 0.5, 20.0
"""Share of the friction from which the push of a fall grows, and its rate in N/s: that edge of the
friction is known to a newton, and where locked fingers come loose by too much the force jumps."""
_EDGE_DOUBT_N = 0.2
"""How uncertain in N the edge of the friction is at which slowly pushed fingers have come loose."""
_NEAR_N = 0.03
"""Distance in N from its end at which a rise is over."""
_BELOW_SDS, _LEAST_BELOW_N, _MOST_BELOW_N = 1.5, 0.05, 0.18
"""How far in N below the force that is asked for a rise ends, by the doubt of the force: what is
missing is added slowly, and the way back costs twice the friction."""


class ForcePlan:
    """Plan of a rise: force, rate and change of the rate, never beyond the set-point of its ramp.

    Parameters
    ----------
    force_n
        Force at the beginning in N.
    """

    def __init__(self, force_n: float) -> None:
        self.force_n = force_n
        self.rate_n_s = 0.0
        self.rate_change_n_s2 = 0.0

    def step(
        self,
        dt_s: float,
        sign: float,
        setpoint_n: float,
        end_n: float,
        *,
        ramp_n_s: float,
        change_n_s2: float,
        most_n_s: float,
    ) -> None:
        """Advance by ``dt_s`` s.

        Parameters
        ----------
        dt_s
            Time since the last step in s.
        sign
            1 where the force rises, -1 where it falls: then rates count downwards.
        setpoint_n
            Set-point of the ramp now in N.
        end_n
            Force in N at which the present change ends.
        ramp_n_s
            Rate of the ramp in N/s.
        change_n_s2
            Largest change of the rate in N/s².
        most_n_s
            Largest rate in N/s.
        """
        if dt_s <= 0.0:
            return
        left_n = max(0.0, sign * (end_n - self.force_n))
        behind_n = sign * (setpoint_n - self.force_n)
        # The rate from which the rest is just enough to come to rest.
        most_n_s = min(most_n_s, sqrt(2.0 * change_n_s2 * left_n))
        wanted_n_s = min(max(0.0, ramp_n_s + behind_n / (2.0 * _FORCE_S)), most_n_s, left_n / dt_s)
        step_n_s = change_n_s2 * dt_s
        before_n_s = self.rate_n_s
        self.rate_n_s = min(wanted_n_s, before_n_s + step_n_s)
        self.rate_change_n_s2 = (self.rate_n_s - before_n_s) / dt_s
        self.force_n += sign * min(left_n, 0.5 * (before_n_s + self.rate_n_s) * dt_s)


class ContactObserver:
    """Kalman filter of force, speed, drive and stiffness of fingers that press on a part.

    The state is: force in N, closing speed of a pad in m/s, what the drive lacks in N, and the
    logarithm of the stiffness at one pad in N/m.

    Parameters
    ----------
    mass_kg
        Moving mass of a finger, as it is at the pad.
    now_s
        Monotonic time in s.
    force_n, doubt_n
        Grip force at the start and its standard deviation in N.
    drive_n
        Driving force at the start in N.
    stiffness_n_m
        Stiffness at one pad in N/m, as far as it is known.
    lacking_n
        What the drive lacks in N, as far as it is known.
    """

    def __init__(
        self,
        *,
        mass_kg: float,
        now_s: float,
        force_n: float,
        doubt_n: float,
        drive_n: float,
        stiffness_n_m: float,
        lacking_n: float = 0.0,
    ) -> None:
        self.mass_kg = mass_kg
        self.force_n = force_n
        self.speed_m_s = 0.0
        self.lacking_n = lacking_n
        self._log_stiffness = log(min(max(stiffness_n_m, _SOFTEST_N_M), _STIFFEST_N_M))
        self._p = [
            [doubt_n**2, 0.0, 0.0, 0.0],
            [0.0, _SPEED_NOISE_M_S**2, 0.0, 0.0],
            [0.0, 0.0, (_DISTURBANCE_SHARE * max(drive_n, 1.0)) ** 2, 0.0],
            [0.0, 0.0, 0.0, _LOG_STIFFNESS_SD**2],
        ]
        self._history = History()
        self._history.add(now_s, force_n)
        self._sample_s = now_s

    @property
    def stiffness_n_m(self) -> float:
        """Stiffness at one pad in N/m."""
        return exp(self._log_stiffness)

    @property
    def doubt_n(self) -> float:
        """Standard deviation of the force in N."""
        return sqrt(max(self._p[0][0], 0.0))

    def speed_after_m_s(self, dt_s: float, drive_n: float, friction_n: float) -> float:
        """Return the speed in m/s after ``dt_s`` s under a drive; 0 where friction locks."""
        push_n = drive_n - self.lacking_n - self.force_n
        speed = self.speed_m_s
        after = speed + (push_n - copysign(friction_n, speed)) * dt_s / self.mass_kg
        if speed * after > 0.0:
            return after
        if abs(push_n) <= STICTION * friction_n:
            return 0.0
        return (push_n - copysign(friction_n, push_n)) * dt_s / self.mass_kg

    def step(
        self,
        now_s: float,
        dt_s: float,
        *,
        drive_n: float,
        friction_n: float,
        speed_m_s: float,
        sample: ForceSample | None,
    ) -> None:
        """Advance to the feedback of now and take it in.

        Parameters
        ----------
        now_s, dt_s
            Monotonic time and time since the last step in s.
        drive_n
            Driving force in N since the last step, by the measured currents.
        friction_n
            Friction of a finger in N.
        speed_m_s
            Closing speed of a pad in m/s, as the servos report it.
        sample
            Newest valid force sample, which may be the same as before; None leaves it out.
        """
        if dt_s > 0.0:
            self._predict(dt_s, drive_n, friction_n)
        self._history.add(now_s, self.force_n)
        self._correct(1, speed_m_s - self.speed_m_s, _SPEED_NOISE_M_S**2)
        if sample is not None and sample.t_s > self._sample_s:
            self._sample_s = sample.t_s
            most_n = max(_BELIEVED_N, _BELIEVED_SDS * sqrt(self._p[0][0] + sample.noise_n**2))
            error_n = min(max(self.unexplained_n(sample), -most_n), most_n)
            before_n = self.force_n
            self._correct(0, error_n, sample.noise_n**2)
            self._history.shift(self.force_n - before_n)

    def open_from(self, drive_n: float, friction_n: float) -> None:
        """Take the drive in N at which fingers came loose and open for the edge of the friction.

        Fingers that came loose later than expected show no new edge.
        """
        edge_n = drive_n - self.force_n + STICTION * friction_n
        if edge_n <= self.lacking_n:
            return
        self.lacking_n = edge_n
        for other in range(4):
            self._p[2][other] = self._p[other][2] = 0.0
        self._p[2][2] = _EDGE_DOUBT_N**2

    def unexplained_n(self, sample: ForceSample) -> float:
        """Return by how much in N a sample is more than the force was when it was measured."""
        return sample.grip_n - self._history.at(sample.measured_s)

    def _predict(self, dt_s: float, drive_n: float, friction_n: float) -> None:
        stiffness, mass = self.stiffness_n_m, self.mass_kg
        speed = self.speed_m_s
        after = self.speed_after_m_s(dt_s, drive_n, friction_n)
        self.force_n = max(0.0, self.force_n + 0.5 * (speed + after) * stiffness * dt_s)
        self.speed_m_s = after
        p = self._p
        if after == 0.0:
            # A locked mass tells nothing about drive and stiffness.
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
            p[2][2] += _DISTURBANCE_N_RS**2 * dt_s
            p[3][3] += _LOG_STIFFNESS_RS**2 * dt_s
        p[0][0] += _FORCE_WANDER_N**2

    def _correct(self, of: int, error: float, noise2: float) -> None:
        """Take one measured entry of the state in."""
        p = self._p
        gains = [p[row][of] / (p[of][of] + noise2) for row in range(4)]
        self.force_n += gains[0] * error
        self.speed_m_s += gains[1] * error
        self.lacking_n += gains[2] * error
        self._log_stiffness = min(
            max(self._log_stiffness + gains[3] * error, log(_SOFTEST_N_M)), log(_STIFFEST_N_M)
        )
        row = list(p[of])
        for i in range(4):
            for j in range(4):
                p[i][j] -= gains[i] * row[j]


class RampMotion:
    """Control of one motion of the force to an end: a fast rise, or a small correction in a hold.

    Parameters
    ----------
    observer
        Of the contact.
    setpoint_n
        Set-point before the motion in N.
    falls
        True for a force that is to fall.
    corrects
        True where the force is held and an error is made up for: it is known well, so that the
        motion ends at the set-point itself.
    """

    def __init__(
        self,
        observer: ContactObserver,
        *,
        setpoint_n: float,
        falls: bool = False,
        corrects: bool = False,
    ) -> None:
        self.over = False
        """Whether the force has arrived and the fingers stand."""
        self._corrects = corrects
        self._late_s = 0.0
        self._locked, self._loosening_s = False, 0.0
        self.plan = ForcePlan(observer.force_n)
        self.observer, self.falls = observer, falls
        self._setpoint_n = setpoint_n
        self._sign = -1.0 if falls else 1.0
        self._rates: deque[float] = deque(maxlen=3)

    def drive_n(
        self,
        dt_s: float,
        setpoint_n: float,
        end_n: float,
        *,
        friction_n: float,
        drive_max_n: float,
        speed_max_m_s: float,
        acting_n: float,
    ) -> float:
        """Advance by one period and return the driving force in N.

        Parameters
        ----------
        dt_s
            Time since the last step in s.
        setpoint_n, end_n
            Set-point of the ramp now, and where its present change ends, in N.
        friction_n
            Friction of a finger in N.
        drive_max_n
            Largest driving force in N.
        speed_max_m_s
            Largest speed of a pad in m/s.
        acting_n
            Driving force in N that acts until the new one does.
        """
        observer, sign = self.observer, self._sign
        stiffness = observer.stiffness_n_m
        at_end = sign * (setpoint_n - end_n) >= 0.0
        if not self._corrects:
            end_n -= sign * min(max(_BELOW_SDS * observer.doubt_n, _LEAST_BELOW_N), _MOST_BELOW_N)
        if dt_s > 0.0:
            self._rates.append(sign * (setpoint_n - self._setpoint_n) / dt_s)
        self._setpoint_n = setpoint_n
        ramp_n_s = max(0.0, *self._rates) if len(self._rates) > 1 else max(0.0, sum(self._rates))
        change_n_s2 = min(
            max(ramp_n_s, _LEAST_RATE_N_S) / _RATE_S, _INERTIA_N * stiffness / observer.mass_kg
        )
        plan = self.plan
        plan.step(
            dt_s,
            sign,
            setpoint_n,
            end_n,
            ramp_n_s=ramp_n_s,
            change_n_s2=change_n_s2,
            most_n_s=speed_max_m_s * stiffness,
        )
        # The new drive acts a little later.
        ahead_s = _WRITE_S + _CURRENT_S
        speed = observer.speed_after_m_s(ahead_s, acting_n, friction_n)
        force_n = observer.force_n + 0.5 * (speed + observer.speed_m_s) * stiffness * ahead_s
        planned_n = plan.force_n + sign * plan.rate_n_s * ahead_s
        error_n = sign * (planned_n - force_n)
        wanted_m_s = max(0.0, plan.rate_n_s + error_n / _FORCE_S) / stiffness
        wanted = sign * min(wanted_m_s, speed_max_m_s)
        accelerates = sign * plan.rate_change_n_s2 / stiffness + (wanted - speed) / _SPEED_S
        # What the force still grows by while friction alone brakes the fingers.
        stopping_n = 0.5 * observer.mass_kg * speed**2 * stiffness / max(friction_n, _NEAR_N)
        arrived = sign * (end_n - force_n) <= _NEAR_N + stopping_n
        if at_end and wanted_m_s < speed_max_m_s:
            self._late_s += dt_s
        stands = abs(speed) * stiffness * _FORCE_S <= _NEAR_N
        self.over = at_end and ((arrived and stands) or self._late_s > _LATE_S)
        band_n = _LOCKED_SHARE * friction_n
        push_n = sign * (friction_n + sign * observer.mass_kg * accelerates)
        if observer.speed_m_s == 0.0:
            push_n = sign * max(sign * push_n, STICTION * friction_n + _BREAKAWAY_N)
            if self.falls:
                self._locked = True
                self._loosening_s += dt_s
                grown_n = _LOOSENED_SHARE * friction_n + _LOOSENING_N_S * self._loosening_s
                push_n = max(push_n, -grown_n)
        elif self._locked:
            self._locked = False
            observer.open_from(acting_n, friction_n)
        if arrived:
            push_n = sign * band_n if stands else 0.0
        push_n = sign * max(sign * push_n, -band_n)
        return min(force_n + observer.lacking_n + push_n, drive_max_n)
