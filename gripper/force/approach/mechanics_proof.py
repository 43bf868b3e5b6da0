"""Proof that the fingers move and stop as direction, zero and linkage of the settings predict.

An encoder measures a servo's motion, not that of a finger: with a wrong ``direction`` it reports an
opening while the fingers close, and in free space nothing shows the difference. The geometry shows
it: no pad passes the other one, so that every opening is 0 or more, and the linkage sets both ends
of the travel. The check is made

1. at rest, by `standing_rows`: in a start, in ``doctor``, and before any torque comes on;
2. in the first opening after the torque has come on, by `FirstMotion`: with the least current that
   moves a finger, all the way; a finger that is blocked, but free on its way back, contradicts the
   settings. The torque goes off: nothing can be held;
3. at the first approach after it that finds nothing, and at each self-zero: an approach continued
   with `meeting_settings` must end where the pads stop each other.

A release with its torque just switched on closes no finger, and so tries no way back: closed
fingers that do not move at all get up to 5 N before the torque goes off.

Forces for 60 mm links on XM430-W350 with the friction of their data; o is the ``offset`` of the
linkage, and the numbers are those of the checks above:

============================= ================================== ==================================
wrong setting                 is found by                        largest force on a part between
============================= ================================== ==================================
``direction`` of both, o = 0  1 where they stand 4 mm open or    none; else 2 N
                              more, else 2
``direction`` of one, o = 0   1 where its finger stands 5 mm or  none; else 2 N
                              more from the middle, else 2
zero: reads too closed        1 where the opening is less than   none; 2 N where the pads meet
                              the error; else 3, after a grasp
                              that found nothing
zero: reads too open          2 where the fingers meet on their  2 N; after that the cap of the
                              way; else a touch, or an           approach
                              obstruction, at that opening
``direction`` or length with  as a zero that is off              as there
o not 0
length with o = 0             not by motion: opening and force   that of the force control; the pads
                              by current are scaled, both stops  measure it
                              agree. Gauge a part
============================= ================================== ==================================
"""

from collections.abc import Sequence
from dataclasses import replace

from gripper.dynamixel.models import ServoModel
from gripper.errors import GripperError, LimitExceeded, MechanicsContradicted
from gripper.force.loop import Action, Moment
from gripper.mechanics.kinematics import (
    MOST_FRICTION,
    Linkage,
    OneFinger,
    motion_currents_a,
    transmissions,
)
from gripper.servos.goal_limits import (
    ServoGoal,
    closing_margin_rad,
    most_closed_rad,
    overrun_rad,
)
from gripper.servos.motion import still_rad
from gripper.servos.plausibility import BEYOND_CLOSED_M
from gripper.settings import GripperSettings
from gripper.values.recent import FRAME_S, LEAST_SAMPLES, RecentForce
from gripper.values.servo_checks import VerificationRow
from gripper.values.state import ServoFeedback, ServoState

POSITION_ITEM = "present_position"
"""Name of the rows that `standing_rows` returns."""
_BEYOND_MIDDLE_M = 0.005
"""Largest distance in m of a finger beyond the middle, if the other finger makes room. [chosen]"""
_LEAST_FORCE_N = 0.5
"""Grip force in N that the least current allows beyond friction. [chosen]"""
_LEAD_RAD = 0.04
"""Largest lead of a goal before its finger in rad: the current is then at its limit.
[resolution]"""
REACHED_PULSES = 2.0
"""Distance in counts of the encoder at which a finger has reached its goal. [resolution]"""
PATIENCE_S = 2.0
"""Time in s after which fingers without progress have not arrived. [chosen]"""
_BLOCKED_S = 0.05
"""Time in s for which a finger stands at the limit of its current before it counts as blocked.
[chosen]"""
_BACK_RAD = 0.03
"""Travel in rad on the way back of a blocked finger that excludes friction as the cause.
[resolution]"""
_RUN_RAD = 0.01
"""Travel in rad that shows that the current moves a finger: more than pads and backlash yield.
[resolution]"""
_RISE_N, _RISE_SHARE = 1.0, 0.2
"""Rise of the grip force in N, or as a share of the force at the start if that is more, that an
opening cannot cause. [chosen]"""
_QUIET_N = 0.15
"""Noise in N of a mean force that is compared: a fraction of the least rise. [tuned]"""
_LONGEST_S = 3 * FRAME_S
"""Longest time in s of its samples: a rise that ends a release is shown by one more than usual."""
ZERO_RANGE_M = 0.006
"""Largest accepted error of the zero of the opening in m, in both directions: empty fingers meet
within it. A tooth of a horn is 15 mm on a link of 60 mm. [chosen]"""
_PADS_GIVE_M = 0.001
"""Yield of two pads that press on each other, in m. [assumed]"""
_LONGER = 3.0
"""Factor on ``contact_timeout_s`` for fingers that close completely. [chosen]"""
_LARGEST_MIN_M = 0.002
"""Largest ``aperture_min_m`` in m from which the fingers close farther to find each other.
[chosen]"""


def closes_farther(settings: GripperSettings, state: ServoFeedback) -> bool:
    """Return whether fingers that have found nothing may close farther."""
    return state.aperture_m <= settings.aperture_min_m <= _LARGEST_MIN_M


def mechanics_text(settings: GripperSettings, linkage: Linkage) -> str:
    """Return the keys of the config that determine the motion of the fingers, with values."""
    directions = ", ".join(str(servo.direction) for servo in settings.servos)
    zeros = ", ".join(str(servo.zero_raw) for servo in settings.servos)
    return (
        f"gripper.servos[].direction ({directions}), gripper.servos[].zero_pulse ({zeros}) and "
        f"gripper.linkage ({linkage})"
    )


def standing_rows(
    settings: GripperSettings, linkage: Linkage, positions_raw: Sequence[int]
) -> tuple[VerificationRow, ...]:
    """Return for each servo whether its position is possible for its finger.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    positions_raw
        Present Position of each servo (register 132).
    """
    halves_m: list[float | None] = []
    for index, (servo, raw) in enumerate(zip(settings.servos, positions_raw, strict=True)):
        halves_m.append(_half_m(linkage, index, servo.angle_rad(raw, servo.turns(raw))))
    opening_m = sum(half_m for half_m in halves_m if half_m is not None) * (2.0 / len(halves_m))
    closed = opening_m < -BEYOND_CLOSED_M
    rows = []
    for index, (servo, raw, half_m) in enumerate(
        zip(settings.servos, positions_raw, halves_m, strict=True)
    ):
        wrong = half_m is None or half_m < (0.0 if closed else -_BEYOND_MIDDLE_M)
        where = "beyond its dead centre" if half_m is None else f"{half_m * 1e3:.1f} mm from it"
        rows.append(
            VerificationRow(
                servo_id=servo.servo_id,
                item=POSITION_ITEM,
                expected="a finger on its own side of the middle",
                found=f"{where}, opening {opening_m * 1e3:.1f} mm, by the position {raw} and "
                f"gripper.servos[{index}].direction {servo.direction}, zero_pulse "
                f"{servo.zero_raw}, gripper.linkage {linkage}"
                if wrong
                else str(raw),
                ok=not wrong,
            )
        )
    return tuple(rows)


def _half_m(linkage: Linkage, index: int, angle_rad: float) -> float | None:
    """Return the distance of a finger from the middle in m; None beyond its dead centre."""
    try:
        linkage.opening_per_rad_m(angle_rad)
    except LimitExceeded:
        return None
    return 0.5 * OneFinger(linkage=linkage, index=index).aperture_m((angle_rad,))


class ForceRise:
    """Detector of a grip force that grows although the fingers open."""

    def __init__(self) -> None:
        self._recent = RecentForce(_QUIET_N, longest_s=_LONGEST_S)
        self._first_n: float | None = None

    def found(self, moment: Moment) -> str:
        """Add the newest sample; return by how much the force has grown as text, or nothing."""
        sample = moment.sample
        if sample is None or not sample.valid or self._recent.push(sample) is None:
            return ""
        if len(self._recent) < LEAST_SAMPLES:
            return ""
        force_n = self._recent.grip_n
        if self._first_n is None:
            self._first_n = force_n
        self._first_n = min(self._first_n, force_n)
        if force_n - self._first_n < max(_RISE_N, _RISE_SHARE * self._first_n):
            return ""
        return f"the pads' force has grown from {self._first_n:.1f} to {force_n:.1f} N"


class FirstMotion:
    """Step of control that moves empty fingers whose torque has just come on to an opening.

    Each finger gets the least current that moves it. A finger that stands still at its limit tries
    the way back. If that is free, the finger is blocked, not held by friction; else its gearing is
    stiff, and it gets more current once. Its goal is then so far ahead that the current flows.

    Parameters
    ----------
    settings, linkage
        Of the gripper.
    state
        Feedback at the start.
    aperture_m
        Opening to reach in m.
    only_open
        True if no finger may close: a blocked finger then does not try the way back.
    """

    def __init__(
        self,
        settings: GripperSettings,
        linkage: Linkage,
        state: ServoFeedback,
        *,
        aperture_m: float,
        only_open: bool = False,
    ) -> None:
        self._settings = settings
        self._linkage = linkage
        self._aperture_m = aperture_m
        self._only_open = only_open
        target_rad = linkage.angles_rad(aperture_m)
        if only_open:
            target_rad = tuple(map(max, target_rad, state.angles_rad))
        paths = transmissions(settings, linkage, state.angles_rad)
        self._currents_a = motion_currents_a(settings, paths, _LEAST_FORCE_N)
        self._stiff_a = [
            min(
                settings.current_max_a,
                current_a
                * max(MOST_FRICTION, path.drive.most_breakaway_a / path.drive.breakaway_a),
            )
            for current_a, path in zip(self._currents_a, paths, strict=True)
        ]
        opening = linkage.aperture_m(target_rad) >= state.aperture_m
        speed_m_s = settings.open_speed_m_s if opening else settings.approach_speed_m_s
        per_rad_m = sum(map(linkage.opening_per_rad_m, state.angles_rad))
        self._fingers = [
            _Finger(
                servo.servo_model,
                start_rad,
                end_rad,
                rate_rad_s=speed_m_s / per_rad_m,
                least_rad=least_rad,
            )
            for servo, start_rad, end_rad, least_rad in zip(
                settings.servos,
                state.angles_rad,
                target_rad,
                most_closed_rad(settings, linkage),
                strict=True,
            )
        ]
        self._deadline_s = state.t_s + PATIENCE_S
        self._back: _Finger | None = None
        self._stands_m = state.aperture_m
        self._rise = ForceRise()

    def step(self, moment: Moment) -> Action:
        """Return the goals of one period; MechanicsContradicted when a finger is blocked."""
        servos = moment.state.servos
        pressed = self._rise.found(moment)
        if self._back is None:
            self._stands_m = moment.state.aperture_m
        if not pressed and moment.now_s > self._deadline_s:
            pressed = "the fingers have not arrived in time"
        if pressed:
            raise self._contradicted(servos[0], pressed)
        goals_rad = []
        for finger, servo, settings in zip(
            self._fingers, servos, self._settings.servos, strict=True
        ):
            drive = self._settings.drives.of(settings.servo_id, settings.drive)
            finger.overrun_rad = overrun_rad(settings.servo_model, drive)
            finger.moved |= finger.has_run(servo)
            # The least current moves a finger as slowly as its friction allows.
            if finger.comes_nearer(servo):
                self._deadline_s = moment.now_s + PATIENCE_S
            if self._back is not None and finger is not self._back:
                finger.begin_at(servo)
                goals_rad.append(servo.angle_rad)
                continue
            goals_rad.append(finger.goal_rad(servo, moment.dt_s, back=self._back is finger))
            if finger.blocked:
                self._turn(finger, servo)
            elif self._back is finger and finger.has_gone_back(servo):
                raise self._contradicted(
                    servo, "it is blocked on its way, and free on its way back"
                )
        goals = [
            ServoGoal(angle_rad=angle_rad, current_a=current_a)
            for angle_rad, current_a in zip(goals_rad, self._currents_a, strict=True)
        ]
        return Action(goals=goals, done=all(finger.there for finger in self._fingers))

    def _turn(self, finger: "_Finger", servo: ServoState) -> None:
        """Turn a blocked finger round, or give it more current, or end the motion."""
        ran_freely = finger.has_run(servo)
        finger.begin_at(servo)
        if self._back is None and finger.opens and not self._only_open:
            self._back = finger
            return
        self._back = None
        # Where no way back is tried, it is enough that the finger has moved with this current.
        may_not_turn = self._only_open or not finger.opens
        index = self._fingers.index(finger)
        stiff = self._currents_a[index] == self._stiff_a[index]
        if stiff or (ran_freely and may_not_turn):
            raise self._contradicted(servo, "it is blocked on its way")
        # A finger that has moved needs no more current.
        for number, other in enumerate(self._fingers):
            if other is finger or not other.moved:
                self._currents_a[number] = self._stiff_a[number]
                if not self._only_open:
                    other.lead_rad = closing_margin_rad(other.model, self._stiff_a[number])

    def _contradicted(self, servo: ServoState, found: str) -> MechanicsContradicted:
        return MechanicsContradicted(
            f"servo {servo.servo_id}: {found}, at an opening of {self._stands_m * 1e3:.1f} mm on "
            f"its way to {self._aperture_m * 1e3:.1f} mm, with {max(self._currents_a):.2f} A, the "
            f"least that moves it. So the settings do not match the position of the fingers, "
            f"something blocks them, or their friction is too high; the torque is switched off. "
            f"Look at the fingers, move them by hand, then check "
            f"{mechanics_text(self._settings, self._linkage)}"
        )


class _Finger:
    """One finger on its way: its goal, ahead by a little only, and how long it has stood."""

    def __init__(
        self,
        model: ServoModel,
        start_rad: float,
        target_rad: float,
        *,
        rate_rad_s: float,
        least_rad: float,
    ) -> None:
        self.model = model
        self._reached_rad = REACHED_PULSES * model.rad_per_pulse
        self._least_rad = min(least_rad, start_rad)
        self.overrun_rad = 0.0
        """Distance in rad of the goal beyond the target, by the newest friction."""
        self.lead_rad = _LEAD_RAD
        """Largest lead of the goal in rad."""
        self._sign = 1.0 if target_rad >= start_rad else -1.0
        self._target_rad = target_rad
        self._from_rad = start_rad
        self._goal_rad = start_rad + 0.5 * self._sign * _LEAD_RAD
        self._rate_rad_s = rate_rad_s
        self._nearest_rad = self._stood_rad = start_rad
        self._still_s = 0.0
        self.there = False
        self.moved = False
        """Whether it has ever moved on its way."""

    @property
    def opens(self) -> bool:
        """Whether it is to open."""
        return self._sign > 0.0

    @property
    def blocked(self) -> bool:
        """Whether it has stood for a while at the limit of its current."""
        return self._still_s >= _BLOCKED_S

    def begin_at(self, servo: ServoState) -> None:
        """Go on from where the finger is, forwards or back."""
        self._from_rad = self._stood_rad = servo.angle_rad
        self._goal_rad = servo.angle_rad + 0.5 * self._sign * _LEAD_RAD
        self._still_s = 0.0

    def has_run(self, servo: ServoState) -> bool:
        """Return whether it has moved on its way since `begin_at`."""
        return self._sign * (servo.angle_rad - self._from_rad) >= _RUN_RAD

    def comes_nearer(self, servo: ServoState) -> bool:
        """Return whether it is nearer to its target than ever, by more than pads yield."""
        nearer = self._sign * (servo.angle_rad - self._nearest_rad) >= _RUN_RAD
        if nearer:
            self._nearest_rad = servo.angle_rad
        return nearer

    def has_gone_back(self, servo: ServoState) -> bool:
        """Return whether it has gone back since `begin_at`."""
        return self._sign * (self._from_rad - servo.angle_rad) >= _BACK_RAD

    def goal_rad(self, servo: ServoState, dt_s: float, *, back: bool) -> float:
        """Return the goal of one period in rad."""
        left_rad = self._sign * (self._target_rad - servo.angle_rad)
        self.there = not back and left_rad <= self._reached_rad
        if self.there:
            self._still_s = 0.0
            self._goal_rad = servo.angle_rad
            return servo.angle_rad
        sign = -self._sign if back else self._sign
        most_rad = max(self.lead_rad, self.overrun_rad)
        if not back:
            most_rad = min(most_rad, left_rad + self.overrun_rad)
        ahead_rad = sign * (self._goal_rad - servo.angle_rad) + self._rate_rad_s * dt_s
        if back:
            ahead_rad = most_rad
        stands = abs(servo.angle_rad - self._stood_rad) < still_rad(self.model)
        self._still_s = self._still_s + dt_s if stands and ahead_rad >= most_rad else 0.0
        if self._still_s == 0.0:
            self._stood_rad = servo.angle_rad
        goal_rad = servo.angle_rad + sign * min(ahead_rad, most_rad)
        self._goal_rad = max(goal_rad, min(self._least_rad, servo.angle_rad))
        return self._goal_rad


def meeting_settings(settings: GripperSettings) -> GripperSettings:
    """Return settings for an approach until the pads of empty fingers meet."""
    return replace(
        settings,
        aperture_min_m=-(ZERO_RANGE_M + _PADS_GIVE_M),
        aperture_pressed_m=None,
        contact_timeout_s=min(_LONGER * settings.contact_timeout_s, 60.0),
    )


def not_met(settings: GripperSettings, linkage: Linkage, state: ServoFeedback) -> GripperError:
    """Return the error of empty fingers that did not stop where their pads must meet.

    If the time ended before, nothing is wrong with the mechanics.
    """
    meeting = meeting_settings(settings)
    if state.aperture_m > meeting.aperture_min_m:
        return LimitExceeded(
            f"the empty fingers should meet, but after {meeting.contact_timeout_s:g} s they have "
            f"closed to {state.aperture_m * 1e3:.1f} mm only. They stand still: clear the fault "
            f"and release, then raise gripper.contact_timeout_s or gripper.approach_speed_mm_s"
        )
    return MechanicsContradicted(
        f"the fingers have found nothing, and stand at an opening of "
        f"{state.aperture_m * 1e3:.1f} mm, at which the pads must have stopped each other: "
        f"the closed position in the settings is wrong, so the torque is switched off. Look "
        f"at the fingers, then check {mechanics_text(settings, linkage)}"
    )
