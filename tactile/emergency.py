"""Emergency (EMCY) messages: what the codes mean. Pure: bytes in, values out."""

import struct
from dataclasses import dataclass

EMCY_BYTES = 8
_LAYOUT = struct.Struct("<HB5s")

ERROR_RESET = 0x0000
WINDOW_EXCEEDED = 0xFF01
SYNC_OVERRUN = 0xFF02
CONVERTER_FAULT = 0xFF03
MULTIPLEXER_FAULT = 0xFF04
ZERO_LOST = 0xFF05
"""Codes that the control unit defines itself; the others are from CiA 301."""

_TEXTS = {
    ERROR_RESET: "no error",
    WINDOW_EXCEEDED: "a burst was cut short, it does not fit into the synchronous window",
    SYNC_OVERRUN: "a SYNC came while the burst before it was still being sent",
    CONVERTER_FAULT: "converter self-test failed",
    MULTIPLEXER_FAULT: "multiplexer self-test failed",
    ZERO_LOST: "the stored zero is damaged",
    0x8110: "CAN overrun, messages lost",
    0x8120: "CAN error-passive",
    0x8130: "heartbeat or life guard error",
    0x8140: "recovered from bus-off",
    0x8150: "CAN identifier collision",
    0x8210: "PDO not processed, too short",
    0x8220: "PDO too long",
    0x8240: "unexpected SYNC length",
    0x8250: "RPDO time-out",
}
_GROUPS = {
    0x10: "generic error",
    0x20: "current",
    0x21: "current at the input",
    0x22: "current inside the device",
    0x23: "current at the output",
    0x30: "voltage",
    0x31: "mains voltage",
    0x32: "voltage inside the device",
    0x33: "output voltage",
    0x40: "temperature",
    0x41: "ambient temperature",
    0x42: "device temperature",
    0x50: "device hardware",
    0x60: "device software",
    0x61: "internal software",
    0x62: "user software",
    0x63: "data set",
    0x70: "additional modules",
    0x80: "monitoring",
    0x81: "communication",
    0x82: "protocol error",
    0x90: "external error",
    0xF0: "additional functions",
    0xFF: "device-specific",
}


def known_codes() -> dict[int, str]:
    """Return the codes whose meaning is exactly known."""
    return dict(_TEXTS)


@dataclass(frozen=True, slots=True, kw_only=True)
class Emergency:
    """An emergency message.

    Attributes
    ----------
    code
        Emergency error code; 0 = the error is gone.
    register
        Error register, object 0x1001.
    detail
        The five manufacturer-specific bytes.
    """

    code: int
    register: int
    detail: bytes

    @property
    def text(self) -> str:
        """Meaning of the code: exact where it is known, else that of its group."""
        exact = _TEXTS.get(self.code)
        if exact is not None:
            return exact
        group = self.code >> 8
        return _GROUPS.get(group) or _GROUPS.get(group & 0xF0) or "unknown code"


def decode_emergency(data: bytes) -> Emergency | None:
    """Return what an EMCY message says; None unless it has exactly 8 bytes (CiA 301)."""
    if len(data) != EMCY_BYTES:
        return None
    code, register, detail = _LAYOUT.unpack(data)
    return Emergency(code=code, register=register, detail=detail)


def encode_emergency(emergency: Emergency) -> bytes:
    """Return the 8 bytes of an EMCY message."""
    return _LAYOUT.pack(emergency.code, emergency.register, emergency.detail)
