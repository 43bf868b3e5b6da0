"""Law of the grip force: a planned force, friction compensation, and pushes against stiction.

Of the set-point s a plan makes a force r whose rate r' has no jump (`ForcePlan`). An observer gives
force F, speed v and missing drive d of the fingers (`gripper.force.control.observer`). With the
mass m, the stiffness k, the friction phi in motion and e = r - F the drive is

    moving   u = F + d + phi sign(v) + m (r''/k + (w - v)/T_v),    w = (r' + e/T_f)/k
    at rest  u = F + d

This is Coulomb friction compensation by the sign of the motion (Armstrong-Helouvry, Dupont and
Canudas de Wit 1994). At rest the drive is in the band of the friction, so nothing hunts.

Friction at rest is larger than in motion, by 1.3 to 1.8 on an XM430. A drive that grows until the
fingers start makes the force jump by twice the difference. So fingers at rest are started by a push
of one period, and come to rest within a fraction of a newton (impulsive control, Armstrong-Helouvry
1991). Where the force should grow faster than such pushes make it, the motion goes on. A push that
starts nothing makes the next one larger.
"""

from collections import deque
from math import copysign, hypot, inf, sqrt
from statistics import fmean

from gripper.dynamixel.drive import SIGMAS
from gripper.errors import LimitExceeded
from gripper.force.certainty import PRESENT_SHARE, STEADY_S, SURE_SDS, YOUNG_S
from gripper.force.control.observer import GripObserver
from gripper.force.estimates.grip import Grip, History
from gripper.force.loop import Moment
from gripper.mechanics.impact import CURRENT_S, current_share, impact_limit
from gripper.mechanics.transmission import Drives, driving_n, mean_friction_n, mean_yielding_n
from gripper.servos.goal_limits import MOST_STICTION, pressing_speed_m_s
from gripper.servos.motion import UNSURE_COUNTS
from gripper.values.force_sensor import FRAME_S, LOOK_BACK_S, QUIET_N, ForceSample

_ACTS_S = 0.001 + CURRENT_S
"""Time in s from the feedback of a period until its goals act: the write and the current.
[assumed]"""
_FORCE_S, _SPEED_S = 2.0 * FRAME_S, 4.0 * CURRENT_S
"""Time constants T_f and T_v in s. After T_v a sample also shows the effect of a push."""
_LEAST_RATE_N_S = 5.0
"""Rate in N/s of the plan of a small change. [chosen]"""
_INERTIA_N = 2.0
"""Largest force in N for the mass in a plan: a soft part makes the plan slower. [chosen]"""
_HOLD_N = 0.15
"""Error in N at which fingers at rest start in a hold: half of the aim of 0.3 N. On a ramp it is
the noise of a mean. Against the direction, through the whole friction, this one comes to it.
[chosen]"""
_NEAR_N = 0.03
"""Distance in N from its end at which a motion stops. [chosen]"""
LOCKED_SHARE = 0.5
"""Share of the friction that starts no finger: by it a drive brakes beside the friction itself,
that of a carried part may grow, and one that stays after an error exceeds the force. [chosen]"""
_STRONGER, _WEAKER = 1.15, 0.98
"""Factors on the assumed stiction after a push without, and with, effect. [chosen]"""
_LEAST_OPENING_SHARE = 0.3
"""Least friction of opening fingers over that of closing ones. [chosen]"""
_MISSING_SDS = 2.0 * SURE_SDS
"""Standard deviations of the servos' force that are no uncertainty of them. [statistics]"""
_MOST_MISSING_N = 3.0
"""Largest missing drive in N, beside the friction and the uncertainty of the servos. [chosen]"""


class ForcePlan:
    """Plan of the force: its rate follows that of the set-point and ends at rest.

    Parameters
    ----------
    force_n, setpoint_n
        Force and set-point at the beginning in N.
    """

    def __init__(self, force_n: float, setpoint_n: float) -> None:
        self.force_n = force_n
        """Planned force in N, never beyond the set-point."""
        self.rate_n_s = 0.0
        self.rate_change_n_s2 = 0.0
        """Its rate in N/s, and the change of the rate in N/s²."""
        self._setpoint_n, self._rates_n_s = setpoint_n, deque([0.0], maxlen=3)

    def step(
        self, dt_s: float, setpoint_n: float, end_n: float, *, most_n_s: float, most_n_s2: float
    ) -> None:
        """Advance by ``dt_s`` s, above 0.

        Parameters
        ----------
        setpoint_n, end_n
            Set-point of the ramp in N, and where its present change ends.
        most_n_s, most_n_s2
            Largest rate of the plan in N/s, and largest change of it in N/s².
        """
        self._rates_n_s.append((setpoint_n - self._setpoint_n) / dt_s)
        self._setpoint_n = setpoint_n
        ramp_n_s = fmean(self._rates_n_s)
        change_n_s2 = min(max(abs(ramp_n_s), _LEAST_RATE_N_S) / FRAME_S, most_n_s2)
        sign = copysign(1.0, end_n - self.force_n)
        left_n, behind_n = abs(end_n - self.force_n), sign * (setpoint_n - self.force_n)
        # The rate from which the rest is just enough to come to rest.
        most_n_s = min(most_n_s, sqrt(2.0 * change_n_s2 * left_n), left_n / dt_s)
        wanted_n_s = min(max(0.0, sign * ramp_n_s + behind_n / (2.0 * _FORCE_S)), most_n_s)
        before_n_s = max(0.0, sign * self.rate_n_s)
        rate_n_s = min(wanted_n_s, before_n_s + change_n_s2 * dt_s)
        self.force_n += sign * min(left_n, 0.5 * (before_n_s + rate_n_s) * dt_s)
        self.rate_n_s = sign * rate_n_s
        self.rate_change_n_s2 = sign * (rate_n_s - before_n_s) / dt_s


class Pushes:
    """Pushes of one period that start locked fingers, and the stiction that they show.

    Parameters
    ----------
    drives
        Keeps the stiction for the next grip.
    """

    def __init__(self, drives: Drives) -> None:
        self._drives = drives
        self.effect_s, self._closing = -inf, True
        """Time in s from which a measurement shows the effect of the last push."""
        self._from_n = self.growth_n = 0.0
        """Force in N before the last push, and its expected growth by it."""

    def push_n(
        self, observer: GripObserver, moment: Moment, frictions_n: tuple[float, float], sign: float
    ) -> float:
        """Return a push in N that starts the fingers, and let the observer assume its effect.

        ``sign``: 1 where they close, -1 where they open.
        """
        closing = sign > 0.0
        self._learn(observer, closing=closing)
        friction_n = frictions_n[0] if closing else frictions_n[1]
        beyond_n, speed_m_s, self.growth_n = self.effect(observer, moment.dt_s, frictions_n[0])
        self._from_n, self._closing = observer.force_n, closing
        self.effect_s = moment.now_s + _SPEED_S
        # The current reaches the push at the end of the period only.
        observer.break_loose(sign * 0.5 * speed_m_s)
        return sign * (friction_n + beyond_n) / current_share(moment.dt_s)

    def effect(self, observer: GripObserver, dt_s: float, friction_n: float) -> tuple[float, ...]:
        """Return a push in N beyond the friction, the speed in m/s after it, and its step in N.

        A spring yields to a sudden drive by the force of twice the drive at most.
        """
        beyond_n = (self._drives.stiction - 1.0) * friction_n + QUIET_N
        speed_m_s = beyond_n * dt_s / observer.mass_kg
        return beyond_n, speed_m_s, min(observer.stiffness_n_m * speed_m_s * dt_s, 2.0 * beyond_n)

    def _learn(self, observer: GripObserver, *, closing: bool) -> None:
        """Compare the growth of the force since the last push with the expected one."""
        drives, grown_n = self._drives, abs(observer.force_n - self._from_n)
        if closing is not self._closing or self.growth_n == 0.0:
            return
        known = self.growth_n > SIGMAS * observer.force_sd_n
        if known and grown_n >= PRESENT_SHARE * self.growth_n:
            drives.stiction = max(1.0, _WEAKER * drives.stiction)
        else:
            drives.stiction = min(MOST_STICTION, _STRONGER * drives.stiction)


class ForceLaw:
    """Law of one grip: one period, from the set-point to the driving force.

    Parameters
    ----------
    grip
        State of the grip, with its force at the start.
    now_s
        Monotonic time in s.
    """

    def __init__(self, grip: Grip, now_s: float) -> None:
        self._grip = grip
        self._pushes = Pushes(grip.mechanics.drives)
        self._carried_n = inf
        self.begin(now_s)

    def begin(self, now_s: float) -> None:
        """Begin at the present force, at a monotonic time in s."""
        grip = self._grip
        self.observer = GripObserver(grip, now_s)
        self.plan = ForcePlan(self.observer.force_n, grip.setpoint_n)
        self._drives_n, self._samples_n, self._balance_n = History(), History(), grip.balance_n
        self._started_m, self._most_m_s = grip.stiffness.apertures.newest, 0.0
        self._jumped_s: float | None = None
        self._contradicted_s = 0.0

    def resume(self) -> None:
        """Begin again after a pause, in which the force may have changed."""
        self.observer.resume()

    def step(self, moment: Moment, end_n: float, *, may_open: bool) -> float:
        """Return the driving force in N of one period.

        Parameters
        ----------
        moment
            Feedback, and a sample: None where it is not valid, or the part may be gone.
        end_n
            Where the present change of the set-point of the grip ends, in N.
        may_open
            Whether the fingers may open farther.

        Raises
        ------
        LimitExceeded
            When the pads report a jump of the force, or contradict the currents for some time.
        """
        grip, sample, observer = self._grip, moment.sample, self.observer
        self._paths = grip.mechanics.transmissions(moment.state.angles_rad)
        self._friction_n = mean_friction_n(self._paths)
        # Where the part is carried, no push opens the fingers.
        carried = moment.now_s >= grip.carried_s
        self._advance_plan(moment, end_n)
        grip.planned_n, grip.rate_n_s = self.plan.force_n, self.plan.rate_n_s
        measured_n = driving_n(moment.state, self._paths)
        before_n = self._drives_n.newest if self._drives_n else measured_n
        self._drives_n.add(moment.now_s, measured_n)
        # A drive at its cap shows nothing of what is missing beyond it.
        observer.missing_n -= max(0.0, self._balance_n - grip.balance_n)
        if sample is not None and self._jumps(sample, moment):
            sample = None
        # A current that did not follow its goal may be read wrongly.
        goal_n = before_n + current_share(moment.dt_s) * (grip.drive_n - before_n)
        drive_n, drive_sd_n = 0.5 * (before_n + measured_n), abs(measured_n - goal_n)
        observer.begin_period(moment.now_s)
        observer.predict(moment.dt_s, drive_n, drive_sd_n, self._frictions_n())
        observer.measure(moment, sample)
        frictions_n = self._frictions_n()
        self._check(moment.dt_s)
        # The new drive acts a little later; until then the last one does.
        speed_m_s = observer.speed_after_m_s(_ACTS_S, grip.drive_n, frictions_n)
        way_m = 0.5 * (observer.speed_m_s + speed_m_s) * _ACTS_S
        force_n = observer.force_n + observer.stiffness_n_m * way_m
        balance_n = force_n + observer.missing_n
        if not carried:
            self._carried_n = balance_n + LOCKED_SHARE * self._friction_n
        grip.force_n, grip.balance_n = observer.force_n, min(balance_n, self._carried_n)
        self._balance_n = grip.balance_n
        # Beyond its cap a push would not start the fingers, and their rest would show nothing.
        if sample is None or balance_n > self._carried_n:
            return grip.balance_n
        error_n = self.plan.force_n + self.plan.rate_n_s * _ACTS_S - force_n
        if observer.speed_m_s == 0.0:
            may_start = error_n > 0.0 or (may_open and not carried)
            may_start &= sample.measured_s > self._pushes.effect_s
            push_n = self._starting_n(moment, error_n, frictions_n) if may_start else 0.0
        else:
            errors_n = error_n, end_n - force_n
            push_n = self._moving_n(moment, sample, errors_n, speed_m_s, frictions_n)
        if carried:
            push_n = max(0.0, push_n)
        return grip.balance_n + push_n

    def _frictions_n(self) -> tuple[float, float]:
        """Return the friction in N at the present speed, while the fingers close and open.

        While they open, the gearing also holds a part of the load.
        """
        paths, force_n = self._paths, self.observer.force_n
        speed_m_s = 2 / len(paths) * self.observer.speed_m_s
        friction_n = fmean(
            [path.drive.moving_a(speed_m_s / path.radius_m) * path.n_per_a for path in paths]
        )
        held_n = force_n - self._friction_n - mean_yielding_n(paths, force_n)
        return friction_n, max(friction_n + held_n, _LEAST_OPENING_SHARE * friction_n)

    def _advance_plan(self, moment: Moment, end_n: float) -> None:
        observer, setpoint_n = self.observer, self._grip.setpoint_n
        impact = impact_limit(self._grip.mechanics, moment.state.angles_rad)
        self._most_m_s = pressing_speed_m_s(self._grip.settings, impact, setpoint_n)
        self.plan.step(
            moment.dt_s,
            setpoint_n,
            end_n,
            most_n_s=self._most_m_s * observer.stiffness_n_m,
            most_n_s2=_INERTIA_N * observer.stiffness_n_m / observer.mass_kg,
        )

    def _starting_n(
        self, moment: Moment, error_n: float, frictions_n: tuple[float, float]
    ) -> float:
        """Return the push in N on fingers at rest: 0, or one that starts them."""
        rate_n_s, sign = self.plan.rate_n_s, copysign(1.0, error_n)
        *_, step_n = self._pushes.effect(self.observer, moment.dt_s, frictions_n[0])
        # A push that changes the force by more than twice the error makes the error larger.
        least_n = _HOLD_N if rate_n_s == 0.0 else QUIET_N
        least_n = max(least_n, self.observer.force_sd_n, 0.5 * step_n)
        if sign * rate_n_s < 0.0 or (sign < 0.0 and rate_n_s == 0.0):
            least_n += _HOLD_N
        if abs(error_n) <= least_n:
            return 0.0
        self._started_m = moment.state.aperture_m
        if sign < 0.0:
            self._grip.opened_s = moment.now_s
        return self._pushes.push_n(self.observer, moment, frictions_n, sign)

    def _moving_n(
        self,
        moment: Moment,
        sample: ForceSample,
        errors_n: tuple[float, float],
        speed_m_s: float,
        frictions_n: tuple[float, float],
    ) -> float:
        """Return the push in N on moving fingers; ``speed_m_s`` is their next speed.

        ``errors_n``: force in N that is missing now, and up to the end of its change.
        """
        observer, plan, (error_n, left_n) = self.observer, self.plan, errors_n
        sign, mass_kg = copysign(1.0, observer.speed_m_s), observer.mass_kg
        stiffness = observer.stiffness_n_m
        friction_n = frictions_n[0] if sign > 0.0 else frictions_n[1]
        wanted_m_s = (plan.rate_n_s + error_n / _FORCE_S) / stiffness
        wanted_m_s = min(max(wanted_m_s, -self._most_m_s), self._most_m_s)
        # Growth of the force while only friction brakes the fingers.
        stopping_n = 0.5 * mass_kg * speed_m_s**2 * stiffness / max(friction_n, _NEAR_N)
        if sign * wanted_m_s <= 0.0 or sign * left_n <= _NEAR_N + stopping_n:
            slow = abs(speed_m_s) * stiffness * _FORCE_S <= _NEAR_N
            return 0.0 if slow else -sign * LOCKED_SHARE * friction_n
        if not self._goes_on(moment, sample, sign * error_n):
            return 0.0
        accelerates = plan.rate_change_n_s2 / stiffness + (wanted_m_s - speed_m_s) / _SPEED_S
        push_n = friction_n + sign * mass_kg * accelerates
        return sign * max(push_n, -LOCKED_SHARE * friction_n)

    def _goes_on(self, moment: Moment, sample: ForceSample, short_n: float) -> bool:
        """Return whether a motion goes on that a push has started.

        It does once the positions show it, or where pushes alone are too slow for the plan.
        """
        way_m = abs(moment.state.aperture_m - self._started_m)
        if way_m > UNSURE_COUNTS * self._grip.stiffness.step_m:
            return True
        growth_n = self._pushes.growth_n
        unseen_s = 2.0 * (moment.now_s - sample.measured_s) + _SPEED_S
        slow = abs(self.plan.rate_n_s) * unseen_s > growth_n
        return slow or short_n > 2.0 * growth_n + max(QUIET_N, self.observer.force_sd_n)

    def _jumps(self, sample: ForceSample, moment: Moment) -> bool:
        """Return whether a sample shows a large jump of the force that no drive has made.

        A law that follows it would release a part although its force has not changed. Raises
        LimitExceeded when the jump lasts.
        """
        observer, setpoint_n = self.observer, self._grip.setpoint_n
        self._samples_n.add(sample.t_s, sample.grip_n)
        # After a wrong prediction the force is unexplained too, but it has not grown.
        grown_n = sample.grip_n - self._samples_n.at(sample.t_s - LOOK_BACK_S)
        jump_n = min(observer.unexplained_n(sample), grown_n)
        settings = self._grip.settings
        least_n = max(settings.slip_drop_n, settings.slip_drop_share * setpoint_n)
        least_n += SURE_SDS * hypot(sample.noise_n, observer.force_sd_n)
        if jump_n <= least_n:
            self._jumped_s = None
            return False
        # A spring that a drive meets at speed is pressed by up to twice the excess of the drive,
        # and by the momentum of the fingers.
        friction_n = min(path.drive.least_breakaway_a * path.n_per_a for path in self._paths)
        drive_n = self._drives_n.most(since_s=sample.measured_s - FRAME_S - _SPEED_S)
        speed_m_s = max(0.0, observer.speed_m_s, -0.5 * moment.state.aperture_velocity_m_s)
        least_n += 2.0 * max(0.0, drive_n - observer.force_n - friction_n)
        least_n += (
            impact_limit(self._grip.mechanics, moment.state.angles_rad).momentum_n_s_m * speed_m_s
        )
        if jump_n <= least_n:
            observer.meets_stiffness(jump_n)
            self._jumped_s = None
            return False
        if self._jumped_s is None:
            self._jumped_s = sample.t_s
        if sample.t_s - self._jumped_s >= YOUNG_S:
            raise LimitExceeded(
                f"the pads report {jump_n:.2f} N more than before on a part that is pressed as "
                f"before, {least_n:.2f} N are allowed: their zero has jumped, or something pushes "
                f"the fingers together. The goals are frozen and the grip kept: check the pads, "
                f"then clear the fault and release"
            )
        return True

    def _check(self, dt_s: float) -> None:
        """Raise LimitExceeded when the drive lacks more than is plausible for some time."""
        missing_n, force_n = self.observer.missing_n, self.observer.force_n
        force_sd_n = max(path.force_sd_n(self._grip.setpoint_n) for path in self._paths)
        limit_n = _MOST_MISSING_N + self._friction_n + _MISSING_SDS * force_sd_n
        plausible = abs(missing_n) <= limit_n
        self._contradicted_s = 0.0 if plausible else self._contradicted_s + dt_s
        if self._contradicted_s > STEADY_S:
            raise LimitExceeded(
                f"force sensor and servo current disagree by {-missing_n:.2f} N, more than "
                f"{limit_n:.2f} N: the sensor shows {force_n:.2f} N where the current makes "
                f"{force_n + missing_n:.2f} N. Check the pads, the tare and the torque figures"
            )
