"""Self-test of the bus watchdog: it must stop this very motor when the host falls silent.

Register 98 alone proves nothing: there is firmware in which it reads -1 and the motor turns on
(330 size, ROBOTIS forum 4814). So the empty, open fingers are sent on a slow, short way, the host
stays silent until the watchdog must have tripped, and the positions tell.
"""

from dataclasses import dataclass

from gripper.clock import Clock
from gripper.errors import LimitExceeded, WatchdogUnproven
from gripper.kinematics import Linkage
from gripper.limits import ServoGoal
from gripper.motion_current import motion_current_a
from gripper.registers import RAD_PER_PULSE, RAD_S_PER_VELOCITY_UNIT
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings
from gripper.state import GripperState

_SPEED_RAW = 4
_START_S = 0.4
_FEED_S = 0.02
_WAY_SHARE = 3.0
_FARTHEST_SHARE = 1.5
_FARTHEST_MORE_PULSES = 4
_SILENT_SHARE = 1.5
_SILENT_MORE_S = 0.02
_REST_S = 0.15
_LEAST_PULSES = 3
_STILL_PULSES = 2
_LONGEST_RAD = 0.2
_FORCE_N = 1.0


@dataclass(frozen=True, slots=True, kw_only=True)
class WatchdogProof:
    """What one servo did.

    Attributes
    ----------
    servo_id
        The servo.
    tripped
        Whether Bus Watchdog (register 98) read -1 after the silence.
    moved_pulses, after_pulses, left_pulses
        How far it had moved in the silence, how far it moved afterwards, and how far its goal
        still was: counts of Present Position.
    farthest_pulses
        How far it may have moved before the watchdog tripped.
    """

    servo_id: int
    tripped: bool
    moved_pulses: int
    after_pulses: int
    left_pulses: int
    farthest_pulses: int

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
    servos: ServoGroup, linkage: Linkage, settings: GripperSettings, clock: Clock
) -> tuple[WatchdogProof, ...]:
    """Let the watchdog trip during a slow motion of the empty, open fingers.

    The torque is on and the watchdog armed before and after it. The motion is a profile of
    0.1 rad/s that goes on for 0.4 s and three times ``watchdog_s``. A servo without a profile in
    this mode (330 size) is at its goal at once, and stays unproven.

    Raises
    ------
    WatchdogUnproven
        When a servo did not stop, did not trip or did not move.
    LimitExceeded
        When the watchdog's time is too long, or the fingers are too closed, for a safe motion.
    """
    speed_rad_s = _SPEED_RAW * RAD_S_PER_VELOCITY_UNIT
    way_rad = speed_rad_s * (_START_S + _WAY_SHARE * settings.watchdog_s)
    farthest_rad = _FARTHEST_SHARE * speed_rad_s * settings.watchdog_s
    if way_rad > _LONGEST_RAD:
        raise LimitExceeded(
            f"watchdog_s is {settings.watchdog_s} s: its self-test would move the fingers by "
            f"{way_rad:.2f} rad, at most {_LONGEST_RAD} rad are allowed; shorten watchdog_s"
        )
    begin = servos.feedback.read()
    goals_rad = [servo.angle_rad - way_rad for servo in begin.servos]
    if linkage.aperture_m(goals_rad) < settings.aperture_min_m:
        raise LimitExceeded(
            f"the fingers stand at {begin.aperture_m * 1e3:.1f} mm, too closed for the self-test "
            f"of the watchdog: open them first"
        )
    paths = servos.feedback.transmissions(begin.servos)
    current_a = motion_current_a(settings, paths, _FORCE_N)
    servos.goals.write(
        [ServoGoal(angle_rad=angle, current_a=current_a) for angle in goals_rad],
        begin,
        profile_velocity_raw=_SPEED_RAW,
    )
    # Against friction the motors start late; until then each reading feeds the watchdog.
    before = begin
    while before.t_s - begin.t_s < _START_S:
        clock.sleep(_FEED_S)
        before = servos.feedback.read()
    clock.sleep(_SILENT_SHARE * settings.watchdog_s + _SILENT_MORE_S)
    stopped = servos.feedback.read()
    clock.sleep(_REST_S)
    later = servos.feedback.read()
    tripped = servos.health.watchdogs_tripped()
    servos.restart_watchdog(current_a)
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
    return proofs


def _pulses(first: GripperState, second: GripperState, index: int) -> int:
    return abs(second.servos[index].position_raw - first.servos[index].position_raw)
