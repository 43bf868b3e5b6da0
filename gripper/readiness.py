"""Torque and bus watchdog as a command needs them before it begins."""

from gripper.errors import ServoFault
from gripper.motion_current import motion_current_a
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings


def make_ready(
    servos: ServoGroup, settings: GripperSettings, *, part_possible: bool, releasing: bool
) -> None:
    """Switch the torque on where it is off, arm or restart the watchdog.

    Goals are set to the present positions before the torque goes on and after a watchdog that
    has tripped, so that nothing jumps.

    Parameters
    ----------
    servos, settings
        Of the gripper.
    part_possible
        True when a part may be held: then a tripped watchdog is a fault.
    releasing
        True when the part is to be let go: then it is not, and torque that was found on at the
        start may be switched off to correct the mode.

    Raises
    ------
    ServoFault
        When the watchdog tripped while a part was held.
    VerificationFailed
        When a servo to be released is not what the settings say.
    """
    health = servos.health
    known = bool(servos.goals.last)
    if releasing and not known and health.torque_on() and not health.verify(correct=False).ok:
        # The release was asked for: only with the torque off can the mode be corrected.
        servos.switch_off()
        health.verify(correct=True, refuse=True)
    if not health.torque_on_everywhere():
        servos.switch_on(_current_a(servos, settings))
    elif not known or health.watchdog_tripped():
        if part_possible and not releasing:
            raise ServoFault(
                settings.servos[0].servo_id,
                0,
                "the bus watchdog has tripped while a part was held, because nobody called tick; "
                "the servos have stopped, the part may still be gripped",
            )
        servos.restart_watchdog(_current_a(servos, settings))
    else:
        servos.arm_watchdog()


def _current_a(servos: ServoGroup, settings: GripperSettings) -> float:
    paths = servos.feedback.transmissions(servos.feedback.read_patiently().servos)
    return motion_current_a(settings, paths, settings.approach_force_n)
