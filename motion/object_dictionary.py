"""Objects of a CiA 402 drive: controlwords, bits of the statusword, states, error codes.

The dictionary is ``drive.eds``, and objects have their names in it. The meaning follows CiA 301
(communication) and CiA 402-2 (drive).
"""

from collections.abc import Mapping
from enum import IntEnum, IntFlag
from functools import cache
from pathlib import Path

import canopen
from canopen.emcy import EmcyError
from canopen.profiles.p402 import State402

EDS_PATH = Path(__file__).with_name("drive.eds")

COB_NMT = 0x000
COB_HEARTBEAT = 0x700
"""Identifiers of the pre-defined connection set (CiA 301, 7.3.5), without the node-ID."""

PROFILE_402 = 402
"""Lower 16 bits of the device type of a drive."""
STOP_WHEN_HOST_IS_LOST = 3
"""Abort connection option for a quick stop when the heartbeat of the host (1016h) is lost."""
STAY_IN_QUICK_STOP = 6
"""Quick stop option for a ramp to QUICK STOP ACTIVE, with torque."""


class HomingMethod(IntEnum):
    """Values of Homing method (6098h) that are used here."""

    NEGATIVE_SWITCH = 17
    POSITIVE_SWITCH = 18
    HERE = 37


NEW_SET_POINT = State402.CW_OPERATION_ENABLED | 0x30
"""Controlword (6040h) with the bits 4, new set-point, and 5, change set immediately."""
START_HOMING = State402.CW_OPERATION_ENABLED | 0x10
"""Controlword with bit 4, which starts homing in that mode."""


class Status(IntFlag):
    """Bits of the statusword (6041h) other than the state."""

    VOLTAGE_ENABLED = 1 << 4
    REMOTE = 1 << 9
    TARGET_REACHED = 1 << 10
    INTERNAL_LIMIT = 1 << 11
    ACKNOWLEDGED = 1 << 12
    """Set-point acknowledged; in homing mode: homing attained."""
    MODE_ERROR = 1 << 13
    """Following error; in homing mode: homing error."""


def state_of(statusword: int) -> str:
    """Return the state of a drive by its name in CiA 402-2; UNKNOWN for no state."""
    states = State402.SW_MASK.items()
    return next((name for name, (mask, bits) in states if statusword & mask == bits), "UNKNOWN")


FOLLOWING_ERROR_CODE = 0x8611
HOST_LOST_CODE = 0x8130
"""Error codes of a following error, and of a lost heartbeat."""
_ERROR_TEXTS: Mapping[int, str] = {
    0x2310: "continuous over-current",
    0x3210: "over-voltage in the DC link",
    0x3220: "under-voltage in the DC link",
    0x4210: "the drive is too hot",
    0x4310: "the motor is too hot",
    0x7121: "the motor is blocked",
    0x7305: "the encoder failed",
    HOST_LOST_CODE: "the host's heartbeat was lost",
    FOLLOWING_ERROR_CODE: "following error: the axis does not follow its set-point",
    0x8612: "a position limit was passed",
}
"""Error codes with their own text (CiA 402-2, 603Fh)."""


def error_code_text(code: int) -> str:
    """Return an error code (603Fh, EMCY) in words, or the group of CiA 301 that it belongs to."""
    group: str = EmcyError(code, 0, b"", 0.0).get_desc()
    text = _ERROR_TEXTS.get(code) or group.lower() or "not specified"
    return f"error {code:04X}h: {text}"


@cache
def of_node(node_id: int) -> canopen.ObjectDictionary:
    """Return the dictionary of the EDS for a node-ID."""
    return canopen.import_od(str(EDS_PATH), node_id)
