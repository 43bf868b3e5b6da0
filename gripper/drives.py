"""Measurement of the drives of the servos: their friction, and their current under load."""

from collections.abc import Mapping

from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.fingers import CLEAR_M, Fingers
from gripper.force.approach.free_motion import MoveTo
from gripper.force.grasp import GraspRun
from gripper.force.load_trial import LoadTrial
from gripper.mechanics.identification import fit_load
from gripper.mechanics.kinematics import transmissions
from gripper.values.state import Observer, TimeSpan

_FREE_RAD_S = (0.15, 0.25, 0.4, 0.65)
"""Speeds in rad/s at which friction is measured: slow enough for its part at rest, and far enough
apart for the rest of it. [chosen]"""
_FREE_S = 0.5
"""Longest time in s of each of these motions. [tuned]"""
_LOW_CONTACTS, _HIGH_SHARE, _LEAST_SPAN_N = 2.5, 0.9, 2.0
"""Least force of the measurement of a drive in contact forces, its largest one as a share of the
force that was held, and the least difference in N of both. [chosen]"""
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
        warnings, self._fingers.health.notes = self._fingers.health.notes, []
        return DriveReport(self._settings.drives.newest, (*notes, *warnings))

    def use(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Use saved drive characteristics, by the servos' IDs."""
        for servo_id, drive in drives.items():
            self._settings.drives.put(servo_id, drive)
        self._fingers.free.forget()

    def measure_load(self, observer: Observer | None = None) -> tuple[TimeSpan, ...]:
        """Measure the current of each servo under load, while the empty pads press on each other.

        Friction locks one finger while the other one moves slowly, then vice versa: the force rises
        and falls. Call it after `Gripper.press_pads_together` with nothing between the pads; they
        still press afterwards. If the current, or the held force, leaves too small a range, the
        drives do not change. Not for a gripper with one servo.

        Returns
        -------
        When each finger moved alone; empty if the drives did not change.

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
            state = fingers.servos.read_patiently()
            paths = transmissions(settings, fingers.linkage, state.angles_rad)
            most_a = _CURRENT_SHARE * settings.current_max_a
            bearable_n = min(path.force_band_n(most_a)[0] for path in paths)
            high_n = min(_HIGH_SHARE * control.grip.setpoint_n, bearable_n)
            if high_n - low_n < _LEAST_SPAN_N or len(paths) < 2:
                return ()
            spans = []
            try:
                for finger, servo in enumerate(settings.servos):
                    trial = LoadTrial(control, fingers.linkage, finger, (low_n, high_n))
                    since_s = state.t_s
                    for rises in (False, True):
                        trial.start(rises=rises)
                        state = fingers.runner.run(trial.step)
                    spans.append(TimeSpan(since_s, state.t_s))
                    before = settings.drives.of(servo.servo_id, servo.drive)
                    found = fit_load(trial.rising, trial.falling, before)
                    settings.drives.put(servo.servo_id, found)
            finally:
                control.grip.moving = None
            fingers.free.compare()
            return tuple(spans)

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
