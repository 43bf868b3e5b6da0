"""Trial of a servo's load: friction locks one finger, and a steady drive moves the other one."""

from math import inf

from gripper.force.control.grip_control import GripControl
from gripper.force.estimates.grip import History
from gripper.force.loop import Action, Moment
from gripper.mechanics.identification import LoadPoint
from gripper.mechanics.kinematics import Linkage, transmissions
from gripper.servos.goal_limits import running_lead_rad

_LOAD_N_S = {True: 8.0, False: 7.0}
"""Rate in N/s of the drive of the moving finger while the force rises (True) and falls: by a drive
that falls a gearing that holds its load gives way two or three times as fast. [chosen]"""
_LOCKED_N_S, _LOCKED_SHARE = 30.0, 0.1
"""The rate while friction locks the finger: until the force has changed by this share of its range.
[chosen]"""
_LIMITED_S = 0.25
"""Time in s without a change of the current after which a limit of the drive has ended it: four
steps of the goal. [chosen]"""


class LoadTrial:
    """Step that measures the load of one finger, and its current, while its goal moves steadily.

    Nothing is controlled by the force: what is unknown is how it follows the current. The position
    controller keeps a gearing from slipping that sticks at rest more than in motion.

    Parameters
    ----------
    control
        Of the pads that press on each other.
    linkage
        Of the gripper.
    finger
        Index of the finger that moves, and of its servo.
    range_n
        Least and largest force in N.
    """

    def __init__(
        self, control: GripControl, linkage: Linkage, finger: int, range_n: tuple[float, float]
    ) -> None:
        self.rising: list[LoadPoint] = []
        self.falling: list[LoadPoint] = []
        self._control = control
        self._linkage = linkage
        self._finger = finger
        self._low_n, self._high_n = range_n
        control.grip.moving = finger
        control.resume()

    def start(self, *, rises: bool) -> None:
        """Start a change of the force."""
        self._rises, self._sign = rises, 1.0 if rises else -1.0
        self._points = self.rising if rises else self.falling
        self._currents = History()
        self._sample_s = self._stalled_s = 0.0
        self._most_a = -inf
        self._from_n: float | None = None
        self._goal_rad: float | None = None
        self._asked_a = 0.0

    def step(self, moment: Moment) -> Action:
        """Return the action of one period."""
        control = self._control
        self._push(moment)
        current_a = -self._sign * moment.state.servos[self._finger].current_a
        self._stalled_s = 0.0 if current_a > self._most_a else self._stalled_s + moment.dt_s
        self._most_a = max(self._most_a, current_a)
        if self._from_n is None and control.watch.pads.recent:
            self._from_n = control.force_n
        moved_n = 0.0 if self._from_n is None else self._sign * (control.force_n - self._from_n)
        locked = moved_n < _LOCKED_SHARE * (self._high_n - self._low_n)
        rate_n_s = _LOCKED_N_S if locked else _LOAD_N_S[self._rises]
        control.grip.trial_rad = self._next_rad(moment, rate_n_s)
        end_n = self._high_n if self._rises else self._low_n
        done = self._sign * (control.force_n - end_n) >= 0.0 or self._stalled_s > _LIMITED_S
        goals = control.goals(moment, self._high_n)
        return Action(goals=goals, setpoint_n=self._high_n, done=done)

    def _next_rad(self, moment: Moment, rate_n_s: float) -> float:
        """Return the goal of the finger, which changes its drive at a rate while it stands."""
        settings = self._control.grip.settings
        model = settings.servos[self._finger].servo_model
        servo = moment.state.servos[self._finger]
        if self._goal_rad is None:
            self._asked_a = servo.current_a
            self._goal_rad = servo.angle_rad + running_lead_rad(model, servo.current_a, 0.0)
        path = transmissions(settings, self._linkage, moment.state.angles_rad)[self._finger]
        before_rad = running_lead_rad(model, self._asked_a, 0.0)
        self._asked_a -= self._sign * rate_n_s * moment.dt_s / path.n_per_a
        self._goal_rad += running_lead_rad(model, self._asked_a, 0.0) - before_rad
        return self._goal_rad

    def _push(self, moment: Moment) -> None:
        servo, sample = moment.state.servos[self._finger], moment.sample
        self._currents.add(moment.now_s, -servo.current_a)
        if sample is None or not sample.valid or sample.t_s <= self._sample_s:
            return
        self._sample_s = sample.t_s
        load_nm = sample.grip_n * self._linkage.effective_radius_m(servo.angle_rad)
        self._points.append(LoadPoint(load_nm, self._currents.at(sample.measured_s)))
