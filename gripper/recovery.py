"""Restarting servos after a shutdown; done on an operator's request only."""

from collections.abc import Sequence

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import BusCorrupt, BusTimeout

_BOOT_S = 0.5
_BOOT_TIMEOUT_S = 3.0
_RETRY_S = 0.1


def reboot_servos(bus: ServoBus, ids: Sequence[int], clock: Clock) -> None:
    """Reboot servos one after the other and wait until each answers again.

    The servos come back with their torque off and their RAM at its defaults. What they were set
    to is verified by the next `gripper.gripper.Gripper.start`.

    Raises
    ------
    BusTimeout
        When a servo does not answer within 3 s.
    """
    for servo_id in ids:
        bus.reboot(servo_id)
        clock.sleep(_BOOT_S)
        deadline_s = clock.monotonic() + _BOOT_TIMEOUT_S
        while True:
            try:
                bus.ping(servo_id)
                break
            except (BusTimeout, BusCorrupt):
                if clock.monotonic() >= deadline_s:
                    raise
            clock.sleep(_RETRY_S)
