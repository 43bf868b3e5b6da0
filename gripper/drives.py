"""Measurement of the drives of the servos: their friction, and their current under load."""

from collections.abc import Mapping
from math import inf

from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.fingers import CLEAR_M, Fingers
from gripper.force.approach.free_motion import MoveTo
from gripper.force.control.grip_control import GripControl
from gripper.force.estimates.history import History
from gripper.force.grasp import GraspRun
from gripper.force.loop import Action, Moment
from gripper.mechanics.identification import LoadPoint, fit_load
from gripper.mechanics.kinematics import Linkage, transmissions
from gripper.servos.goals import running_lead_rad
from gripper.values.state import Observer

_FREE_RAD_S = (0.15, 0.25, 0.4, 0.65)
"""Speeds in rad/s at which friction is measured: slow enough for its part at rest, and far enough
apart for the rest of it. [chosen]"""
_FREE_S = 0.5
"""Longest time in s of each of these motions. [tuned]"""
_LOW_CONTACTS, _HIGH_SHARE, _LEAST_SPAN_N = 2.5, 0.9, 2.0
"""Least force of the measurement of a drive in contact forces, its largest one as a share of the
force that was held, and the least difference in N of both. [chosen]"""
_LOAD_N_S = {True: 8.0, False: 7.0}
"""Rate in N/s of the drive of that measurement while the force rises (True) and falls: by a drive
that falls a gearing that holds its load gives way two or three times as fast. [chosen]"""
_LOCKED_N_S, _LOCKED_SHARE = 30.0, 0.1
"""The same while friction locks the finger: until the force has changed by this share of its range.
[chosen]"""
_LIMITED_S = 0.25
"""Time in s without a change of the current after which a limit of the drive has ended it: four
steps of the goal. [chosen]"""
_CURRENT_SHARE = 0.9
"""Largest share of the current limit in this measurement. [chosen]"""


class DriveMeasurement:
    """Measures the drive of each servo with empty fingers; the results are in the settings.

    Parameters
    ----------
    fingers, grasping
        Of the gripper.
    """

    def __init__(self, fingers: Fingers, grasping: GraspRun) -> None:
        self._fingers = fingers
        self._grasping = grasping
        self._settings = fingers.settings

    def read(self) -> DriveReport:
        """Return the newest drive characteristic of each servo, and notes about unusual values."""
        free = self._fingers.free
        notes, free.notes = free.notes, []
        return DriveReport(self._settings.drives.newest, tuple(notes))

    def use(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Use saved drive characteristics, by the servos' IDs."""
        for servo_id, drive in drives.items():
            self._settings.drives.put(servo_id, drive)
        self._fingers.free.forget()

    def measure_load(self, observer: Observer | None = None) -> None:
        """Measure the current of each servo under load, while the empty pads press on each other.

        Friction locks one finger while the other one moves slowly, then vice versa: the force rises
        and falls. Call it after `Gripper.press_pads_together` with nothing between the pads; they
        still press afterwards. If the current, or the held force, leaves too small a range, the
        drives do not change. Not for a gripper with one servo.

        Raises
        ------
        As `Gripper.hold`.
        """
        fingers, settings = self._fingers, self._settings
        fingers.life.check_ready("hold")
        control = self._grasping.held("hold")
        with fingers.life.command("hold", observer):
            fingers.make_ready()
            low_n = _LOW_CONTACTS * settings.contact_force_n
            angles_rad = fingers.servos.read_patiently().angles_rad
            paths = transmissions(settings, fingers.linkage, angles_rad)
            most_a = _CURRENT_SHARE * settings.current_max_a
            bearable_n = min(path.force_band_n(most_a)[0] for path in paths)
            high_n = min(_HIGH_SHARE * control.grip.setpoint_n, bearable_n)
            if high_n - low_n < _LEAST_SPAN_N or len(paths) < 2:
                return
            try:
                for finger, servo in enumerate(settings.servos):
                    trial = LoadTrial(control, fingers.linkage, finger, (low_n, high_n))
                    for rises in (False, True):
                        trial.start(rises=rises)
                        fingers.runner.run(trial.step)
                    before = settings.drives.of(servo.servo_id, servo.drive)
                    found = fit_load(trial.rising, trial.falling, before)
                    settings.drives.put(servo.servo_id, found)
            finally:
                control.grip.moving = None
            fingers.free.compare()

    def measure_friction(self, observer: Observer | None = None) -> None:
        """Measure the friction of each servo at several speeds; the empty fingers end open.

        They close to a gap without a check of the pads: nothing may be between them.
        """
        fingers, settings = self._fingers, self._settings
        wide_m = settings.aperture_open_m
        near_m = max(settings.aperture_min_m, 0.0) + CLEAR_M
        fingers.life.check_ready("open")
        with fingers.life.command("open", observer):
            fingers.make_ready()
            for speed_rad_s in _FREE_RAD_S:
                for closes in (True, False):
                    state = fingers.servos.read_patiently()
                    reach_m = sum(map(fingers.linkage.opening_per_rad_m, state.angles_rad))
                    speed_m_s = speed_rad_s * reach_m
                    end_m = max(near_m, wide_m - _FREE_S * speed_m_s) if closes else wide_m
                    move = MoveTo(
                        settings, fingers.linkage, state, aperture_m=end_m, speed_m_s=speed_m_s
                    )
                    fingers.run_free(move, state)
            # The back-EMF is known now.
            fingers.free.compare()


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
            self._goal_rad = servo.angle_rad + running_lead_rad(model, servo.current_a, 0.0)
        path = transmissions(settings, self._linkage, moment.state.angles_rad)[self._finger]
        change_a = self._sign * rate_n_s * moment.dt_s / path.n_per_a
        self._goal_rad -= running_lead_rad(model, change_a, 0.0)
        return self._goal_rad

    def _push(self, moment: Moment) -> None:
        servo, sample = moment.state.servos[self._finger], moment.sample
        self._currents.add(moment.now_s, -servo.current_a)
        if sample is None or not sample.valid or sample.t_s <= self._sample_s:
            return
        self._sample_s = sample.t_s
        load_nm = sample.grip_n * self._linkage.effective_radius_m(servo.angle_rad)
        self._points.append(LoadPoint(load_nm, self._currents.at(sample.measured_s)))
