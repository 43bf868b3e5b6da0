"""What is written to the servos when something goes wrong: the grip is kept wherever it can be.

HOLD: goals stay at or below their last values; fingers on their way stop where they are. One
finger never pushes alone: where the other one has no torque or is silent, the living one stands
where it is. LIMP: the torque goes off where the position is unknown, or where the settings ask for
it with too much force. A lost bus is not written to: the servos' own watchdog acts.
"""

from contextlib import suppress
from enum import StrEnum

from gripper.errors import (
    BusCorrupt,
    BusTimeout,
    FeedbackImplausible,
    FingerSilent,
    ForceAboveCap,
    GripperError,
    PortLost,
    ServoFault,
)
from gripper.servos import ServoGroup
from gripper.settings import GripperSettings, OverForce


class Left(StrEnum):
    """How the fingers are left: of moving ones it is told where they were."""

    STILL = "stopped"
    LIMP = "lost their torque"
    ALONE = "were seen last"


def bus_is_lost(error: BaseException | None) -> bool:
    """Say whether a fault means that nobody listens on the bus any more."""
    return isinstance(error, PortLost | BusTimeout | BusCorrupt) and not isinstance(
        error, FingerSilent
    )


def react(
    error: BaseException, servos: ServoGroup, settings: GripperSettings, *, moving: bool
) -> Left:
    """Do at once what a fault asks for; what the bus does not take is left to the watchdog.

    Parameters
    ----------
    error
        What went wrong.
    servos, settings
        Of the gripper.
    moving
        Whether the fingers were on their way with nothing in their grip yet, or any more.
    """
    if bus_is_lost(error):
        return Left.ALONE
    # No patience here: a servo that does not answer must not hold up the others.
    with servos.in_loop():
        over_force = isinstance(error, ForceAboveCap) or servos.goals.guard.force_is_too_high()
        limp = over_force and settings.over_force is OverForce.LIMP
        if limp or isinstance(error, FeedbackImplausible):
            servos.go_limp()
            return Left.LIMP
        opens = over_force and settings.over_force is OverForce.OPEN
        halts = moving and not opens
        alone = servos.standstill.halt() if halts else []
        with suppress(GripperError):
            if opens:
                servos.standstill.open_a_step()
            elif over_force:
                servos.standstill.lower_currents()
            elif isinstance(error, FingerSilent) or (
                isinstance(error, ServoFault) and error.torque_lost
            ):
                servos.standstill.stand_still()
            elif not halts:
                servos.standstill.calm()
        servos.disarm_each(but=alone)
    return Left.ALONE if alone else Left.STILL
