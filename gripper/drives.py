"""Measurement of the drives of the servos: their friction, and their current under load."""

from collections.abc import Callable, Mapping

from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.force.approach.empty_motion import FirstMotion, MoveTo
from gripper.force.estimates.free_motion import FreeMotion
from gripper.force.grasp import GraspRun
from gripper.force.load_trial import LoadTrial
from gripper.force.loop import LoopRunner
from gripper.lifecycle import Lifecycle
from gripper.mechanics.identification import fit_load
from gripper.mechanics.kinematics import Linkage, transmissions
from gripper.values.state import Observer, ServoFeedback, TimeSpan

CLEAR_M = 0.002
"""Way in m after which nothing touches fingers that open. [chosen]"""

_FREE_RAD_S = (0.15, 0.25, 0.4, 0.65)
"""Speeds in rad/s at which friction is measured: slow enough for its part at rest, and far enough
apart for the rest of it. [chosen]"""
_FREE_S = 0.5
"""Longest time in s of each of these motions. [tuned]"""
_LOW_CONTACTS, _HIGH_SHARE, _LEAST_SPAN_N = 2.5, 0.9, 2.0
"""Forces between which a drive is measured: the least in contact forces, the largest as a share of
the held force, and the least difference of both in N. [chosen]"""
_CURRENT_SHARE = 0.9
"""Largest share of the current limit in this measurement. [chosen]"""


def run_free(
    free: FreeMotion, runner: LoopRunner, move: FirstMotion | MoveTo, state: ServoFeedback
) -> ServoFeedback:
    """Run a motion of empty fingers from a state, and measure their friction."""

    def is_free(now: ServoFeedback) -> bool:
        # A part that is let go, and foam, push the fingers open at first.
        return abs(now.aperture_m - state.aperture_m) >= CLEAR_M

    return free.run(runner, move.step, is_free, needs_force=False)


class DriveMeasurement:
    """Measures the drive of each servo with empty fingers; the results are in the settings.

    Parameters
    ----------
    runner, life, free, grasping, linkage
        Of the gripper.
    make_ready
        Prepares the servos for a command.
    """

    def __init__(
        self,
        runner: LoopRunner,
        life: Lifecycle,
        free: FreeMotion,
        grasping: GraspRun,
        *,
        linkage: Linkage,
        make_ready: Callable[[], object],
    ) -> None:
        self._runner = runner
        self._servos, self._settings = runner.servos, runner.servos.settings
        self._life = life
        self._free = free
        self._grasping = grasping
        self._linkage = linkage
        self._make_ready = make_ready

    def read(self) -> DriveReport:
        """Return the newest drive characteristic of each servo, and notes about unusual values."""
        free, health = self._free, self._servos.health
        notes, free.notes = free.notes, []
        warnings, health.notes = health.notes, []
        return DriveReport(self._settings.drives.newest, (*notes, *warnings))

    def use(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Use saved drive characteristics, by the servos' IDs."""
        for servo_id, drive in drives.items():
            self._settings.drives.put(servo_id, drive)
        self._free.forget()

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
        settings, linkage = self._settings, self._linkage
        self._life.check_ready("hold")
        control = self._grasping.held("hold")
        with self._life.command("hold", observer):
            self._make_ready()
            low_n = _LOW_CONTACTS * settings.contact_force_n
            state = self._servos.read_patiently()
            paths = transmissions(settings, linkage, state.angles_rad)
            most_a = _CURRENT_SHARE * settings.current_max_a
            bearable_n = min(path.force_band_n(most_a)[0] for path in paths)
            high_n = min(_HIGH_SHARE * control.grip.setpoint_n, bearable_n)
            if high_n - low_n < _LEAST_SPAN_N or len(paths) < 2:
                return ()
            spans = []
            try:
                for finger, servo in enumerate(settings.servos):
                    trial = LoadTrial(control, linkage, finger, (low_n, high_n))
                    since_s = state.t_s
                    for rises in (False, True):
                        trial.start(rises=rises)
                        state = self._runner.run(trial.step)
                    spans.append(TimeSpan(since_s, state.t_s))
                    before = settings.drives.of(servo.servo_id, servo.drive)
                    drive = fit_load(trial.rising, trial.falling, before)
                    settings.drives.put(servo.servo_id, drive)
            finally:
                control.begin_again(state)
            self._free.compare()
            return tuple(spans)

    def measure_friction(self, observer: Observer | None = None) -> None:
        """Measure the friction of each servo at several speeds; the empty fingers end open.

        They close to a gap without a check of the pads: nothing may be between them.
        """
        settings, linkage = self._settings, self._linkage
        wide_m = settings.aperture_open_m
        near_m = max(settings.aperture_min_m, 0.0) + CLEAR_M
        self._life.check_ready("open")
        with self._life.command("open", observer):
            self._make_ready()
            for speed_rad_s in _FREE_RAD_S:
                for closes in (True, False):
                    state = self._servos.read_patiently()
                    reach_m = sum(map(linkage.opening_per_rad_m, state.angles_rad))
                    speed_m_s = speed_rad_s * reach_m
                    end_m = max(near_m, wide_m - _FREE_S * speed_m_s) if closes else wide_m
                    move = MoveTo(settings, linkage, state, aperture_m=end_m, speed_m_s=speed_m_s)
                    run_free(self._free, self._runner, move, state)
            # The back-EMF is known now.
            self._free.compare()
