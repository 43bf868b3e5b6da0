"""Free motion of the fingers, which gives the friction of each servo."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import hypot, sqrt
from statistics import fmean, pstdev
from typing import NamedTuple

import numpy as np

from gripper.dynamixel.drive import INERTIA_SD, SIGMAS, DriveCharacteristic
from gripper.errors import ServoFault
from gripper.force.loop import Action, LoopRunner, Moment, Step
from gripper.mechanics.identification import FreePoint, change, fit_friction, grown
from gripper.servos.motion import position_sd_rad, slow_rad_s
from gripper.settings import ServoSettings
from gripper.values.state import ServoFeedback, ServoState

_BEFORE_END_S = 0.05
"""Time in s before the end of a closing motion that is left out: the pads report a contact late.
[tuned]"""
_WINDOW_S = 0.4
"""Time in s of free motion for one point. [tuned]"""
_LEAST_PERIODS = 32
"""Fewest periods of a point: in half of them, 0.08 s at 200 Hz, the counts of the encoder show an
acceleration to 1 rad/s². [resolution]"""
_FIRST_PERIODS = 3 * _LEAST_PERIODS // 4
"""Fewest periods of the first point: a motion of 2 mm by each finger gives a better friction than
the catalogue."""
_EVEN_SHARE = 0.15
"""Share by which the currents of both halves of a free motion may differ, without what accelerates
them; and largest share of a first point that the inertia leaves uncertain. [tuned]"""
_SAME_SPEED = 1.3
"""Ratio of speeds below which they are one point: the newest motion counts. [chosen]"""
_FEW_POINTS, _MOST_POINTS = 4, 16
"""Fewest points for the friction at all speeds, and number of newest points kept. [chosen]"""
_WORN = 5.0
"""Ratio of the friction to the catalogue's above which a servo is not sound. A servo without a
load may have a tenth of the catalogue's, as an XL330's gearing (arXiv 2410.08650). [assumed]"""

_FRICTION = ("coulomb_a", "viscous_a_s", "offset_a", "breakaway_a", "friction_sd")
"""Fields of a drive characteristic that free motions measure."""


class FreeMotion:
    """Watcher of the servos during free motion; keeps their friction in its drives.

    Parameters
    ----------
    runner
        Runner of the motions.
    """

    def __init__(self, runner: LoopRunner) -> None:
        self._runner = runner
        self._settings = settings = runner.servos.settings
        self._drives = runner.servos.mechanics.drives
        self._runs = [_Run(servo) for servo in settings.servos]
        self.notes: list[str] = []
        """Unusual changes that were not yet fetched."""

    def forget(self) -> None:
        """Discard all points: the characteristics were replaced."""
        for run in self._runs:
            run.points, run.prior = [], None

    def distrust(self) -> None:
        """Put the catalogue's friction back: the servos may be others, or a cable was freed."""
        self.forget()
        for servo in self._settings.servos:
            usual = DriveCharacteristic.catalogue(servo.servo_model)
            self._drives.put(servo.servo_id, _with_friction(usual, self._drives.of(servo)))

    def run(
        self, step: Step, is_free: Callable[[ServoFeedback], bool], *, needs_force: bool = True
    ) -> ServoFeedback:
        """Run a motion of empty fingers and use its result; return the last feedback.

        ``is_free``: whether nothing touches the fingers. Raises as `LoopRunner.run`, and ServoFault
        where a servo needs more current than a sound one.
        """
        for run in self._runs:
            run.start()

        def watched(moment: Moment) -> Action:
            self._push(moment, free=is_free(moment.state))
            return step(moment)

        state = self._runner.run(watched, needs_force=needs_force)
        for run, servo in zip(self._runs, state.servos, strict=True):
            self._take(run, servo)
        return state

    def _push(self, moment: Moment, *, free: bool) -> None:
        """Add one period, with all fingers moving ``free``, or with a possible contact."""
        for run, servo in zip(self._runs, moment.state.servos, strict=True):
            if not (free and run.goes_on(servo)):
                self._take(run, servo)
                run.start()
            run.add(moment.now_s, servo)
            if not self._drives.of(run.settings).measured and run.lasts():
                # The rest of the first motion uses the result of its beginning.
                self._take(run, servo)

    def compare(self) -> None:
        """Note contradictions of pads and motor constant: neither follows the other."""
        for servo in self._settings.servos:
            times = self._drives.of(servo).disagreement(servo.servo_model)
            begin = f"servo {servo.servo_id}: by the pads"
            if times != 1.0 and not any(note.startswith(begin) for note in self.notes):
                self.notes.append(
                    f"{begin} 1 A makes {times:.2f} times the torque of its motor constant: "
                    f"the law of the pads, or the current scale, is off. Press a known weight on "
                    f"the pads: step pads_law of `tactile-cell commission`"
                )

    def _take(self, run: "_Run", servo: ServoState) -> None:
        """Fit the friction of a servo again with its motion."""
        drive, servo_id, points = self._drives.of(run.settings), servo.servo_id, run.points
        point = run.point(drive)
        if point is None:
            return
        prior = run.prior or drive
        earlier = [old for old in points if _alike(old, point)]
        # The first motions give little information on other speeds.
        few = not prior.measured and 0 < len(points) < _FEW_POINTS and not earlier
        ratio = 1.0 if few else change(point, drive)
        if ratio != 1.0:
            self._note(servo_id, ratio)
            points.clear()
            earlier.clear()
            prior = drive.distrusted
        # Temperature changes the friction of all speeds.
        follows = grown(point, drive) if earlier else 1.0
        others = [old for old in points if not _alike(old, point)][1 - _MOST_POINTS :]
        points[:] = [old._replace(current_a=follows * old.current_a) for old in others]
        points.append(point)
        run.prior = prior.with_friction(follows)
        fitted = fit_friction(points, _with_friction(run.prior, drive))
        fitted = replace(
            fitted,
            breakaway_a=fitted.coulomb_a * drive.breakaway_share,
            temperature_c=servo.temperature_c,
        )
        self._drives.put(servo_id, fitted)
        usual_a = DriveCharacteristic.catalogue(run.model).breakaway_a
        if fitted.breakaway_a > _WORN * usual_a:
            raise ServoFault(
                servo_id,
                f"its free motion takes {fitted.breakaway_a:.3f} A, {usual_a:.3f} A are usual for "
                f"a {run.model.name}: a cable drags, or it is worn. Free the finger, or change "
                f"the servo; then clear the fault, release and start",
            )

    def _note(self, servo_id: int, ratio: float) -> None:
        slack = "its horn or linkage is loose, or its grease is warm"
        cause = "a cable drags, or it is worn or cold" if ratio > 1.0 else slack
        self.notes.append(
            f"servo {servo_id}: its free motion takes {ratio:.2f} times the current of before: "
            f"{cause}. It is measured anew; `tactile-cell hand zero` measures the rest"
        )


def _with_friction(other: DriveCharacteristic, drive: DriveCharacteristic) -> DriveCharacteristic:
    """Return a drive with the friction of another one."""
    return replace(drive, **{name: getattr(other, name) for name in _FRICTION})


def _alike(point: FreePoint, other: FreePoint) -> bool:
    return 1.0 / _SAME_SPEED < point.speed_rad_s / other.speed_rad_s < _SAME_SPEED


class _Part(NamedTuple):
    """Means of a part of a motion."""

    speed_rad_s: float
    current_a: float
    acceleration_rad_s2: float
    acceleration_sd_rad_s2: float
    """Its uncertainty by the resolution of the positions."""


class _Run:
    """Motion of one servo in one direction, and the points of its earlier motions."""

    def __init__(self, settings: ServoSettings) -> None:
        self.settings = settings
        self.model = model = settings.servo_model
        self.points: list[FreePoint] = []
        self.prior: DriveCharacteristic | None = None
        """Drive before these points; None before the first one."""
        pwm_a = model.stall_current_a / model.whole_pwm_raw
        self._step_a = (pwm_a if model.supply_current else model.current_unit_a) / sqrt(12.0)
        self.start()

    def start(self) -> None:
        """Start another motion."""
        self._sign = 0.0
        self._periods: deque[tuple[float, ServoState]] = deque()
        """Monotonic time in s and feedback of the servo in the last periods."""

    def goes_on(self, servo: ServoState) -> bool:
        """Return whether a servo moves in the direction of before."""
        speed = servo.velocity_rad_s
        return abs(speed) > slow_rad_s(self.model) and speed * self._sign >= 0.0

    def add(self, now_s: float, servo: ServoState) -> None:
        """Add one period."""
        self._sign = servo.velocity_rad_s
        self._periods.append((now_s, servo))
        while self._periods[0][0] < now_s - _WINDOW_S - _BEFORE_END_S:
            self._periods.popleft()

    def _inner(self) -> list[tuple[float, ServoState]]:
        """Return the periods of free motion."""
        if not self._periods:
            return []
        end_s = self._periods[-1][0] - (_BEFORE_END_S if self._sign < 0.0 else 0.0)
        return [(t_s, servo) for t_s, servo in self._periods if t_s <= end_s]

    def lasts(self) -> bool:
        """Return whether the motion is long enough for a point."""
        return len(self._inner()) >= _LEAST_PERIODS

    def _part(self, periods: Sequence[tuple[float, ServoState]]) -> "_Part":
        """Return a part of the motion by a parabola through its positions (least squares)."""
        t_s = np.array([now_s for now_s, _ in periods])
        t_s -= t_s.mean()
        whole = np.linalg.pinv(np.column_stack([np.ones(len(t_s)), t_s, 0.5 * t_s**2]))
        _, speed_rad_s, acceleration_rad_s2 = whole @ [servo.angle_rad for _, servo in periods]
        return _Part(
            speed_rad_s=float(speed_rad_s),
            current_a=fmean(servo.current_a for _, servo in periods),
            acceleration_rad_s2=float(acceleration_rad_s2),
            acceleration_sd_rad_s2=position_sd_rad(self.model) * float(np.linalg.norm(whole[2])),
        )

    def point(self, drive: DriveCharacteristic) -> FreePoint | None:
        """Return the point of the motion; None where it was too short.

        The current that accelerates the servo is taken out by the inertia of its ``drive``.
        """
        inner = self._inner()
        if len(inner) < (_LEAST_PERIODS if drive.measured else _FIRST_PERIODS):
            return None
        half = len(inner) // 2
        inertia_a_s2 = drive.inertia_a_s2(self.model)
        whole, *halves = map(self._part, (inner, inner[:half], inner[half:]))
        whole_a, first_a, second_a = (
            part.current_a - inertia_a_s2 * part.acceleration_rad_s2 for part in (whole, *halves)
        )
        # Currents of neighbouring periods have a common error.
        spread_a = pstdev([servo.current_a for _, servo in inner]) / sqrt(len(inner) / 4.0)
        unlike_a = _EVEN_SHARE * abs(whole_a) + SIGMAS * hypot(
            2.0 * spread_a, *(inertia_a_s2 * part.acceleration_sd_rad_s2 for part in halves)
        )
        if whole.speed_rad_s * whole_a <= 0.0 or abs(second_a - first_a) > unlike_a:
            # The servo is driven from outside, or presses on something.
            return None
        inertia_sd_a = INERTIA_SD * abs(whole.current_a - whole_a)
        if not drive.measured and 2.0 * inertia_sd_a > _EVEN_SHARE * abs(whole_a):
            return None
        sd_a = hypot(spread_a, self._step_a, inertia_sd_a)
        return FreePoint(whole.speed_rad_s, whole_a, sd_a)
