"""The force message: the force on both gripping pads in 8 bytes, many times a second. Pure.

Byte 0 has the counter in the low nibble, the status in the high one. Then follow the force on
finger 0 and finger 1 (i16 little-endian, 2 mN). The next two bytes are the centre of force of both
pads together, along and across the fingers (i8). Its unit is 1/16 of the taxels' pitch, from the
middle of the pads. The last byte is the CRC-8 of SAE J1850 over the 7 bytes before it. This is
similar to AUTOSAR's E2E profile 1, with a counter of 4 bits and a CRC of 8.

The host writes two objects for the sum of the force, each with a CRC-16 at its end. They are the
table of counts to force and the zero of each taxel. Equation (11) is not linear in counts, so the
sum of counts is not a force. All numbers of both are u16 little-endian.
"""

import struct
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile.errors import FrameError
from tactile.frames.transport import CRC_BYTES, MESSAGE_BYTES, crc16_ccitt
from tactile.layout import TaxelLayout
from tactile.source import ForceMessage, ForceStatus

FORCE_N = 0.002
"""Unit of a force in N: from -65 to 65 N."""
CENTRE_TAXELS = 1.0 / 16.0
"""Unit of a centre in pitches of the taxels: from -8 to 8."""
TABLE_NODES = 129
"""Nodes of the table of one pad, evenly from 0 counts to full scale; linear between them."""
TABLE_N = 0.0005
"""Unit of the table's forces in N: up to 32 N a taxel."""
ZERO_STEPS = 60_000
"""Steps of a zero, and of the threshold, in the full scale of the counts."""
BAD_TAXEL = 0xFFFF
"""Zero of a taxel that does not measure: its neighbours are used instead."""
COUNTERS = 16
"""Number of counters before a counter repeats."""
_NO_CENTRE = -128
"""Centre without a touch."""
_BODY = struct.Struct("<Bhhbb")
_STATUS_SHIFT = 4
_CRC8_POLYNOMIAL, _CRC8_START, _CRC8_END = 0x11D, 0xFF, 0xFF
"""CRC-8 of SAE J1850 (AUTOSAR, Specification of CRC Routines, 7.2.1.1)."""


def _divided(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (_CRC8_POLYNOMIAL if byte & 0x80 else 0)
    return byte


_CRC8_TABLE = bytes(map(_divided, range(256)))


def crc8(data: bytes | bytearray) -> int:
    """Return the CRC-8 of SAE J1850."""
    crc = _CRC8_START
    for byte in data:
        crc = _CRC8_TABLE[crc ^ byte]
    return crc ^ _CRC8_END


def decode_force_message(data: bytes | bytearray, t_s: float) -> ForceMessage:
    """Return the message in 8 bytes received at ``t_s`` s; FrameError for damaged ones."""
    if len(data) != MESSAGE_BYTES:
        raise FrameError(f"a force message has {len(data)} bytes, expected {MESSAGE_BYTES}")
    body = data[: _BODY.size]
    if crc8(body) != data[-1]:
        raise FrameError(f"force CRC is 0x{data[-1]:02X}, computed 0x{crc8(body):02X}")
    head, first, second, along, across = _BODY.unpack(body)
    return ForceMessage(
        t_s=t_s,
        counter=head % COUNTERS,
        status=ForceStatus(head >> _STATUS_SHIFT),
        force_n=(first * FORCE_N, second * FORCE_N),
        centre_taxels=None
        if along == _NO_CENTRE
        else (along * CENTRE_TAXELS, across * CENTRE_TAXELS),
    )


ForceLaw = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Forces of all taxels in N, of their tared counts: `Calibration.force_n` of the sensor."""


def force_table(layout: TaxelLayout, law: ForceLaw) -> bytes:
    """Return object 0x2141, the table of counts to force of both gripping pads."""
    table_n = np.empty((2, TABLE_NODES))
    for node in range(TABLE_NODES):
        force_n = law(np.full(layout.n_taxels, layout.adc_max * node / (TABLE_NODES - 1)))
        for finger, pad in enumerate(layout.gripping_pads):
            table_n[finger, node] = force_n[layout.taxels_of(pad)].mean()
    if not np.isfinite(table_n).all():
        raise FrameError("the calibration has forces that are not finite: correct it")
    return _with_crc(np.clip(np.rint(table_n / TABLE_N), 0, 0xFFFF))


def encode_zero(
    touch_counts: float, zero_counts: NDArray[np.float64], bad: NDArray[np.bool_], adc_max: int
) -> bytes:
    """Return the object of the zero.

    Parameters
    ----------
    touch_counts
        Least counts above the zero of a touched taxel, in the mean of its neighbourhood.
    zero_counts : (n,) float64
        Zero of each taxel of the gripping pads, finger 0 first.
    bad : (n,) bool
        Taxels that do not measure.
    """
    steps = np.append(touch_counts, zero_counts) * (ZERO_STEPS / adc_max)
    steps = np.clip(np.rint(steps), 0, ZERO_STEPS)
    steps[1:][bad] = BAD_TAXEL
    return _with_crc(steps)


def _with_crc(numbers: NDArray[Any]) -> bytes:
    content = numbers.astype("<u2").tobytes()
    return content + crc16_ccitt(content).to_bytes(CRC_BYTES, "little")
