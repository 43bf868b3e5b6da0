"""Self-test of the bus watchdog: it must stop each motor when the host falls silent.

Register 98 alone proves nothing: there is firmware in which it reads -1 and the motor turns on
(330 size, ROBOTIS forum 4814). So the empty, open fingers are sent on a slow, short way, the host
stays silent until the watchdog must have tripped, and the positions are compared.
"""

from dataclasses import dataclass

from gripper.clock import Clock
from gripper.dynamixel.control_table import RAD_PER_PULSE, RAD_S_PER_VELOCITY_UNIT
from gripper.errors import LimitExceeded, WatchdogUnproven
from gripper.kinematics import Linkage, motion_current_a, transmissions
from gripper.servos.goals import ServoGoal
from gripper.servos.group import ServoGroup
from gripper.servos.health import ServoHealth
from gripper.settings import GripperSettings
from gripper.state import GripperState

_SPEED_RAW = 4
"""Profile Velocity (register 112) of the test motion: 0.1 rad/s."""
_SPEED_RAD_S = _SPEED_RAW * RAD_S_PER_VELOCITY_UNIT
"""The same in rad/s."""
_FORCE_N = 1.0
"""Grip force in N that the current of the test motion allows beyond friction."""
_START_S = 0.4
"""Time in s in which the motors start against friction and reach the speed."""
_FEED_S = 0.02
"""Time in s between two readings, which feed the watchdog, until then."""
_WAY_SHARE = 3.0
"""Time for which the motion would go on afterwards, in multiples of ``watchdog_s``."""
_SILENT_SHARE, _SILENT_MORE_S = 1.5, 0.02
"""Silence of the host, in multiples of ``watchdog_s`` and, on top, a unit of the watchdog in s."""
_REST_S = 0.15
"""Time in s for which a stopped motor is watched."""
_FARTHEST_SHARE, _FARTHEST_MORE_PULSES = 1.5, 4
"""Longest way until the trip, in multiples of that in ``watchdog_s``, and on top in pulses."""
_LEAST_PULSES = 3
"""Way in pulses that counts as motion, and that must be left to the goal."""
_STILL_PULSES = 2
"""Way in pulses that counts as rest: noise of the encoder."""
_LONGEST_RAD = 0.2
"""Longest way in rad of the test motion: 12 mm of a finger with links of 60 mm."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchdogProof:
    """Result of the self-test for one servo."""

    servo_id: int
    """The servo."""
    tripped: bool
    """Whether Bus Watchdog (register 98) read -1 after the silence."""
    moved_pulses: int
    after_pulses: int
    left_pulses: int
    """How far it had moved in the silence, how far it moved afterwards, and how far its goal still
    was: counts of Present Position."""
    farthest_pulses: int
    """How far it may have moved before the watchdog tripped."""

    @property
    def ok(self) -> bool:
        """True when the servo was on its way, tripped and stood still short of its goal."""
        return (
            self.tripped
            and _LEAST_PULSES <= self.moved_pulses <= self.farthest_pulses
            and self.left_pulses >= _LEAST_PULSES
            and self.after_pulses <= _STILL_PULSES
        )

    def __str__(self) -> str:
        return (
            f"servo {self.servo_id}: register 98 {'tripped' if self.tripped else 'did not trip'}, "
            f"{self.moved_pulses} pulses in the silence ({_LEAST_PULSES} to {self.farthest_pulses} "
            f"expected), {self.after_pulses} after it, "
            f"{self.left_pulses} short of its goal"
        )


def prove_watchdog(
    servos: ServoGroup,
    health: ServoHealth,
    linkage: Linkage,
    settings: GripperSettings,
    clock: Clock,
) -> None:
    """Let the watchdog trip during a slow motion of the empty, open fingers.

    The torque is on and the watchdog armed before and after it. The motion is a profile of 0.1
    rad/s that goes on for 0.4 s and three times ``watchdog_s``. A servo without a profile in this
    mode (330 size) is at its goal at once, and stays unproven. Raises WatchdogUnproven when a servo
    did not stop, did not trip or did not move. Raises LimitExceeded when the watchdog's time is too
    long, or the fingers are too closed, for a safe motion.
    """
    way_rad = _way_rad(settings)
    begin = servos.read()
    goals_rad = [angle_rad - way_rad for angle_rad in begin.angles_rad]
    if linkage.aperture_m(goals_rad) < settings.aperture_min_m:
        raise LimitExceeded(
            f"the fingers stand at {begin.aperture_m * 1e3:.1f} mm, too closed for the self-test "
            f"of the watchdog: open them first"
        )
    paths = transmissions(settings, linkage, begin.angles_rad)
    current_a = motion_current_a(settings, paths, _FORCE_N)
    servos.write_goals(
        [ServoGoal(angle_rad=angle, current_a=current_a) for angle in goals_rad],
        begin,
        profile_velocity_raw=_SPEED_RAW,
    )
    # Against friction the motors start late; until then each reading feeds the watchdog.
    before = begin
    while before.t_s - begin.t_s < _START_S:
        clock.sleep(_FEED_S)
        before = servos.read()
    clock.sleep(_SILENT_SHARE * settings.watchdog_s + _SILENT_MORE_S)
    stopped = servos.read()
    clock.sleep(_REST_S)
    later = servos.read()
    tripped = health.watchdogs_tripped()
    servos.restart_watchdog(current_a)
    farthest_rad = _FARTHEST_SHARE * _SPEED_RAD_S * settings.watchdog_s
    proofs = tuple(
        WatchdogProof(
            servo_id=servo.servo_id,
            tripped=servo.servo_id in tripped,
            moved_pulses=_pulses(before, stopped, index),
            after_pulses=_pulses(stopped, later, index),
            farthest_pulses=round(farthest_rad / RAD_PER_PULSE) + _FARTHEST_MORE_PULSES,
            left_pulses=round((later.servos[index].angle_rad - goals_rad[index]) / RAD_PER_PULSE),
        )
        for index, servo in enumerate(before.servos)
    )
    if not all(proof.ok for proof in proofs):
        raise WatchdogUnproven(
            "the bus watchdog is not proven to stop the motors: "
            + "; ".join(str(proof) for proof in proofs if not proof.ok)
            + ". Do not run this gripper unattended; update the firmware or replace the servo, or "
            "switch watchdog_self_test off to work attended"
        )


def _way_rad(settings: GripperSettings) -> float:
    """Return the way of the test motion in rad; LimitExceeded when it is too long."""
    way_rad = _SPEED_RAD_S * (_START_S + _WAY_SHARE * settings.watchdog_s)
    if way_rad > _LONGEST_RAD:
        raise LimitExceeded(
            f"watchdog_s is {settings.watchdog_s} s: its self-test would move the fingers by "
            f"{way_rad:.2f} rad, at most {_LONGEST_RAD} rad are allowed; shorten watchdog_s"
        )
    return way_rad


def _pulses(first: GripperState, second: GripperState, index: int) -> int:
    return abs(second.servos[index].position_raw - first.servos[index].position_raw)
