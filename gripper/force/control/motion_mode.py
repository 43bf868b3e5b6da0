"""Mode of control that changes the grip force by a planned motion of the fingers.

Motor and finger, seen at the pad, are a mass; friction brakes it, and a spring of pad and part
pushes it back. A rise of the force is a motion of that mass: force and speed follow a plan with a
smooth rate. The inertia, the friction and the stiffness of the part, learnt in each contact, are
fed forward. At the end the mass is at rest, and friction locks it.
A motion also corrects a small error of a hold.
"""

from collections import deque
from math import exp, sqrt
from statistics import fmean

from gripper.force.control.period import Mode, Period
from gripper.force.estimates.contact_observer import LOG_STIFFNESS_SD, ContactObserver
from gripper.force.estimates.grip import Grip
from gripper.mechanics.impact import CURRENT_S, impact_limit
from gripper.mechanics.kinematics import driving_n
from gripper.servos.goal_limits import STICTION, pressing_speed_m_s

_WRITE_S = 0.001
"""Time in s from the feedback of a period to the write of its goals. [assumed]"""
_RATE_S = 0.025
"""Time in s in which the rate of a plan reaches that of its ramp, and returns to 0. [tuned]"""
_INERTIA_N = 2.0
"""Largest force in N for the mass in a plan: a soft part makes the plan slower. [tuned]"""
_FORCE_S, SPEED_S = 0.04, 0.012
"""Time constants in s of the correction of force and speed errors. [tuned]"""
_LATE_S = 0.3
"""Time in s after the end of its ramp at which a motion is abandoned: something else is wrong.
[chosen]"""
_LEAST_RATE_N_S = 5.0
"""Rate in N/s that the plan of a small correction assumes. [tuned]"""
_LOCKED_SHARE = 0.5
"""Share of the friction beyond the force at which the drive stays: friction locks the fingers.
[tuned]"""
_BREAKAWAY_N = 0.1
"""Drive in N beyond friction at rest that starts locked fingers. Where the force is beyond its
set-point by more, they stay locked. [tuned]"""
_LOOSENED_SHARE, _LOOSENING_N_S = 0.5, 20.0
"""Share of the friction at which the push of a fall begins to grow, and its rate in N/s. That edge
of the friction is exact to a newton; after too large a push the force jumps. [tuned]"""
_NEAR_N = 0.03
"""Distance in N from its end at which a rise is over. [tuned]"""
_BELOW_SDS, _LEAST_BELOW_N, _MOST_BELOW_N = 1.5, 0.05, 0.18
"""Distance in N below the set-point at which a rise ends, by the uncertainty of the force: the rest
is added slowly, and the way back costs twice the friction. [tuned]"""


class MotionMode(Mode):
    """Mode of control that moves the fingers so that the force follows a plan to its end.

    Parameters
    ----------
    grip
        What is known and asked of the grip.
    now_s
        Monotonic time in s.
    pad_n_m, pad_log_sd
        Stiffness of pad and part at one pad in N/m, as the contact has shown it, and the standard
        deviation of its logarithm.
    """

    observer: ContactObserver
    """Of the present or last motion; its learnt values are kept for the next one."""

    def __init__(
        self, grip: Grip, now_s: float, pad_n_m: float, pad_log_sd: float = LOG_STIFFNESS_SD
    ) -> None:
        self.over = False
        """Whether the force has arrived and the fingers stand."""
        self.ended_s = self.moved_s = now_s
        """Monotonic time in s of the detected end of the last motion, and of its last period."""
        self.setpoint_n = grip.setpoint_n
        """Set-point in N of that period."""
        self._grip = grip
        self._pad_n_m = pad_n_m
        self._pad_log_sd = pad_log_sd
        self._lacking_n: dict[bool, float] = {}

    def enter(self, period: Period, before: Mode) -> None:
        """Begin a motion from the present force: of the set-point, or of a correction."""
        grip, estimate = self._grip, self._grip.estimate
        force_n = estimate.force_n
        corrects = period.rises_n == 0.0
        falls = corrects and period.setpoint_n < force_n
        self._corrects, self._falls, self._sign = corrects, falls, -1.0 if falls else 1.0
        self.setpoint_n = force_n if corrects else period.setpoint_n - period.rises_n
        self.over, self._late_s = False, 0.0
        self._locked, self._loosening_s = False, 0.0
        self._rates: deque[float] = deque(maxlen=3)
        self._measured_n = driving_n(period.state, period.paths)
        other_n = self._lacking_n.get(not falls, -estimate.bias_n)
        self.observer = ContactObserver(
            grip,
            period.moment.now_s - period.moment.dt_s,
            stiffness_n_m=self._pad_n_m,
            log_stiffness_sd=self._pad_log_sd,
            lacking_n=self._lacking_n.get(falls, other_n),
        )
        self.plan = ForcePlan(self.observer.force_n, self._sign)

    def exit(self, period: Period) -> None:
        """End the motion, and keep its measurements of part and friction."""
        self._pad_n_m = self.observer.stiffness_n_m
        self._pad_log_sd = LOG_STIFFNESS_SD
        self._lacking_n[self._falls] = self.observer.lacking_n
        if period.usable and (self.over or period.rises_n < 0.0):
            self.ended_s = period.moment.now_s
            if self.over:
                self._grip.asked_n = period.setpoint_n

    def step(self, period: Period) -> float:
        """Return the driving force in N of one period.

        Raises
        ------
        LimitExceeded
            When sensor and model disagree, see `ForceEstimate.jumps` and `check`.
        """
        grip, observer, sample = self._grip, self.observer, period.sample
        estimate, frictions_n = grip.estimate, self._frictions_n(period)
        friction_n = frictions_n[self._falls]
        moment, setpoint_n = period.moment, period.setpoint_n
        measured_n = driving_n(period.state, period.paths)
        since_s, jump_n = moment.now_s - sample.measured_s, observer.unexplained_n(sample)
        moved_n = abs(observer.speed_m_s) * observer.stiffness_n_m * since_s
        jumped = estimate.jumps(sample, jump_n, setpoint_n, friction_n, moved_n=moved_n)
        mean_n, seen = 0.5 * (self._measured_n + measured_n), None if jumped else sample
        observer.step(moment, drive_n=mean_n, frictions_n=frictions_n, sample=seen)
        self._measured_n = measured_n
        if (shown_n_m := grip.stiffness.stiffness_n_m) is not None:
            observer.learn_stiffness(2.0 * shown_n_m, grip.stiffness.log_sd)
        grip.quiet_n = self._planned_drive_n(period)
        grip.asked_n, grip.rate_n_s = self.plan.force_n, self.plan.rate_n_s
        self.moved_s = moment.now_s
        estimate.follow(moment.now_s, sample, observer)
        estimate.check(moment.now_s, sample, friction_n, period.doubt_n)
        return grip.quiet_n

    def _frictions_n(self, period: Period) -> tuple[float, float]:
        """Return the friction in N at the present speed, while the fingers close and open.

        While they open, the gearing also holds a part of the load.
        """
        fingers, force_n = 2 / len(period.paths), max(0.0, self.observer.force_n)
        friction_n = fmean(
            path.drive.moving_a(fingers * self.observer.speed_m_s / path.radius_m) * path.n_per_a
            for path in period.paths
        )
        held_n = force_n - period.friction_n - period.yielding_n(force_n)
        return friction_n, friction_n + held_n

    def _brake_n(
        self, period: Period, frictions_n: tuple[float, float], stopping_share: float
    ) -> float:
        """Return by how many N the drive must be below the force to brake in time.

        A gearing that holds a part of the load brakes so. ``stopping_share`` is the growth of the
        force while friction alone brakes, over the growth that is left.
        """
        heavier = exp(max(path.drive.inertia_sd for path in period.paths))
        brake_n = (heavier * stopping_share - 1.0) * frictions_n[self._falls]
        return max(0.0, min(brake_n, _LOCKED_SHARE * (frictions_n[1] - frictions_n[self._falls])))

    def _loosening_n(self, push_n: float, friction_n: float, dt_s: float) -> float:
        """Return the push in N that starts locked fingers; a fall begins with less, which grows."""
        if not self._falls:
            return max(push_n, STICTION * friction_n + _BREAKAWAY_N)
        self._locked = True
        self._loosening_s += dt_s
        grown_n = _LOOSENED_SHARE * friction_n + _LOOSENING_N_S * self._loosening_s
        return max(min(push_n, -STICTION * friction_n - _BREAKAWAY_N), -grown_n)

    def _planned_drive_n(self, period: Period) -> float:
        """Advance the plan by one period and return the driving force in N that follows it."""
        grip, observer, sign, dt_s = self._grip, self.observer, self._sign, period.moment.dt_s
        setpoint_n, end_n, frictions_n = period.setpoint_n, period.end_n, self._frictions_n(period)
        friction_n, stiffness = frictions_n[self._falls], observer.stiffness_n_m
        impact = impact_limit(grip.settings, grip.linkage, period.state.angles_rad)
        speed_max_m_s = pressing_speed_m_s(grip.settings, impact, setpoint_n)
        at_end = sign * (setpoint_n - end_n) >= 0.0
        if not self._corrects:
            end_n -= sign * min(max(_BELOW_SDS * observer.doubt_n, _LEAST_BELOW_N), _MOST_BELOW_N)
        if dt_s > 0.0:
            self._rates.append(sign * (setpoint_n - self.setpoint_n) / dt_s)
        self.setpoint_n = setpoint_n
        ramp_n_s = max(0.0, *self._rates) if len(self._rates) > 1 else max(0.0, sum(self._rates))
        change_n_s2 = min(
            max(ramp_n_s, _LEAST_RATE_N_S) / _RATE_S, _INERTIA_N * stiffness / observer.mass_kg
        )
        plan = self.plan
        most_n_s = speed_max_m_s * stiffness
        plan.step(dt_s, setpoint_n, end_n, rates_n_s=(ramp_n_s, most_n_s), change_n_s2=change_n_s2)
        # The new drive acts a little later; until then the last one does.
        ahead_s = _WRITE_S + CURRENT_S
        speed = observer.speed_after_m_s(ahead_s, grip.drive_n, frictions_n)
        force_n = observer.force_n + 0.5 * (speed + observer.speed_m_s) * stiffness * ahead_s
        planned_n = plan.force_n + sign * plan.rate_n_s * ahead_s
        error_n = sign * (planned_n - force_n)
        wanted_m_s = max(0.0, plan.rate_n_s + error_n / _FORCE_S) / stiffness
        wanted = sign * min(wanted_m_s, speed_max_m_s)
        accelerates = sign * plan.rate_change_n_s2 / stiffness + (wanted - speed) / SPEED_S
        # Growth of the force while only friction brakes the fingers.
        stopping_n = 0.5 * observer.mass_kg * speed**2 * stiffness / max(friction_n, _NEAR_N)
        left_n = sign * (end_n - force_n)
        arrived = left_n <= _NEAR_N + stopping_n
        brake_n = self._brake_n(period, frictions_n, stopping_n / max(left_n, _NEAR_N))
        stands = abs(speed) * stiffness * _FORCE_S <= _NEAR_N
        self._late_s += dt_s if at_end and stands and not self._locked else 0.0
        self.over = at_end and ((arrived and stands) or self._late_s > _LATE_S)
        band_n = _LOCKED_SHARE * friction_n
        push_n = sign * (friction_n + sign * observer.mass_kg * accelerates)
        ahead = sign * (force_n - setpoint_n) > _BREAKAWAY_N
        if observer.speed_m_s == 0.0 and not ahead:
            push_n = self._loosening_n(push_n, friction_n, dt_s)
        elif self._locked and observer.speed_m_s != 0.0:
            self._locked = False
            observer.open_from(grip.drive_n, friction_n)
        # Fingers that still open after the longest time must be locked too.
        if arrived or (self.over and self._falls):
            push_n = sign * band_n if stands else -brake_n
        if ahead and stands:
            # In the middle of the band wrong friction moves nothing.
            push_n = sign * min(sign * push_n, 0.0)
        push_n = sign * max(sign * push_n, -max(band_n, brake_n))
        return min(force_n + observer.lacking_n + push_n, period.drive_max_n - period.inertia_n)


class ForcePlan:
    """Plan of a rise: force, rate and change of the rate, never beyond the set-point of its ramp.

    Parameters
    ----------
    force_n
        Force at the beginning in N.
    sign
        1 where the force rises, -1 where it falls: then rates count downwards.
    """

    def __init__(self, force_n: float, sign: float) -> None:
        self.force_n = force_n
        self._sign = sign
        self.rate_n_s = 0.0
        self.rate_change_n_s2 = 0.0

    def step(
        self,
        dt_s: float,
        setpoint_n: float,
        end_n: float,
        *,
        rates_n_s: tuple[float, float],
        change_n_s2: float,
    ) -> None:
        """Advance by ``dt_s`` s.

        Parameters
        ----------
        dt_s
            Time since the last step in s.
        setpoint_n
            Set-point of the ramp now in N.
        end_n
            Force in N at which the present change ends.
        rates_n_s
            Rate of the ramp, and largest rate, in N/s.
        change_n_s2
            Largest change of the rate in N/s².
        """
        if dt_s <= 0.0:
            return
        (ramp_n_s, most_n_s), sign = rates_n_s, self._sign
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
