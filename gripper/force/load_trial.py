"""Trial of a servo's load: friction locks one finger, and a steady drive moves the other one."""

from math import inf

from gripper.force.certainty import STEADY_S
from gripper.force.control.grip_control import GIVE_RAD, GripControl
from gripper.force.estimates.grip import History
from gripper.force.loop import Action, Moment
from gripper.mechanics.identification import LoadPoint
from gripper.servos.goal_limits import ServoGoal, most_closed_rad, running_lead_rad

_LOAD_N_S = {True: 8.0, False: 7.0}
"""Rate in N/s of the drive of the moving finger while the force rises (True) and falls: by a drive
that falls a gearing that holds its load gives way two or three times as fast. [chosen]"""
_LOCKED_N_S, _LOCKED_SHARE = 30.0, 0.1
"""The rate while friction locks the finger: until the force has changed by this share of its range.
[chosen]"""


class LoadTrial:
    """Step that measures the load of one finger, and its current, while its goal moves steadily.

    Nothing is controlled by the force: what is unknown is how it follows the current. The position
    controller keeps a gearing from slipping that sticks at rest more than in motion.

    Parameters
    ----------
    control
        Of the pads that press on each other.
    finger
        Index of the finger that moves, and of its servo.
    range_n
        Least and largest force in N.
    """

    def __init__(self, control: GripControl, finger: int, range_n: tuple[float, float]) -> None:
        self.rising: list[LoadPoint] = []
        self.falling: list[LoadPoint] = []
        self._control, self._mechanics = control, control.grip.mechanics
        self._finger = finger
        self._low_n, self._high_n = range_n
        self._held_rad: tuple[float, ...] = ()
        control.resume(self._high_n)

    def start(self, *, rises: bool) -> None:
        """Start a change of the force."""
        self._rises, self._sign = rises, 1.0 if rises else -1.0
        self._points = self.rising if rises else self.falling
        self._currents = History()
        self._sample_s = self._stalled_s = 0.0
        self._most_a = -inf
        self._from_n: float | None = None
        self._goal_rad: float | None = None

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
        end_n = self._high_n if self._rises else self._low_n
        done = self._sign * (control.force_n - end_n) >= 0.0 or self._stalled_s > STEADY_S
        goals = self._goals(moment, rate_n_s)
        return Action(goals=goals, setpoint_n=self._high_n, done=done)

    def _goals(self, moment: Moment, rate_n_s: float) -> list[ServoGoal]:
        """Return the goals of the moving finger, and of the other one, which holds its position."""
        settings, state = self._control.grip.settings, moment.state
        paths = self._mechanics.transmissions(state.angles_rad)
        self._held_rad = self._held_rad or state.angles_rad
        goals = []
        for index, (path, own) in enumerate(zip(paths, settings.servos, strict=True)):
            most_a = min(settings.current_max_a, path.pressing_current_a(settings.force_max_n))
            if index == self._finger:
                least_rad = most_closed_rad(self._mechanics)[index]
                angle_rad = max(self._next_rad(moment, path.n_per_a, rate_n_s), least_rad)
                angle_rad = min(angle_rad, self._held_rad[index] + GIVE_RAD)
            else:
                load_a = max(self._control.force_n, 0.0) / path.n_per_a
                lead_rad = running_lead_rad(own.servo_model, load_a, 0.0)
                angle_rad = self._held_rad[index] - lead_rad
                most_a = min(most_a, load_a + path.drive.most_breakaway_a)
            goals.append(ServoGoal(angle_rad=angle_rad, current_a=most_a, setpoint_n=self._high_n))
        return goals

    def _next_rad(self, moment: Moment, n_per_a: float, rate_n_s: float) -> float:
        """Return the goal of the finger, which changes its drive at a rate while it stands."""
        model = self._control.grip.settings.servos[self._finger].servo_model
        servo = moment.state.servos[self._finger]
        if self._goal_rad is None:
            self._asked_a = servo.current_a
            self._goal_rad = servo.angle_rad + running_lead_rad(model, servo.current_a, 0.0)
        before_rad = running_lead_rad(model, self._asked_a, 0.0)
        self._asked_a -= self._sign * rate_n_s * moment.dt_s / n_per_a
        self._goal_rad += running_lead_rad(model, self._asked_a, 0.0) - before_rad
        return self._goal_rad

    def _push(self, moment: Moment) -> None:
        """Use the newest sample: a point of the load. Raises as `PartWatch.check_pads`."""
        servo, sample = moment.state.servos[self._finger], moment.sample
        self._currents.add(moment.now_s, -servo.current_a)
        if sample is None or not sample.valid or sample.t_s <= self._sample_s:
            return
        self._sample_s = sample.t_s
        self._control.watch.pads.take(sample)
        self._control.watch.check_pads(moment, rises=False)
        load_nm = sample.grip_n * self._mechanics.linkage.effective_radius_m(servo.angle_rad)
        self._points.append(LoadPoint(load_nm, self._currents.at(sample.measured_s)))
