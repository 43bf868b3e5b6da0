"""Pad features, which the control unit can send instead of the samples: the reduced traffic.

Two messages a pad and scan. TPDO2: header (phase in the two top bits, pad below), active taxels u8,
peak u16, total u32. TPDO3: the same header, frame counter's low byte, centroid row u16 and column
u16 in 1/256 taxel, CRC-16/CCITT-FALSE u16 over the 14 bytes before it. All little-endian.
"""

import struct
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile.errors import FrameError
from tactile.frames.codec import (
    CRC_BYTES,
    INDEX_BITS,
    MESSAGE_BYTES,
    PHASE_SHIFT,
    PHASES,
    crc16,
)
from tactile.layout import TaxelLayout

MAX_PADS = INDEX_BITS + 1
"""Pads that the header of a message can name."""
_FIRST = struct.Struct("<BBHL")
"""TPDO2: header, active taxels, peak, total."""
_SECOND = struct.Struct("<BBHH")
"""TPDO3 without its CRC: header, counter, centroid row and column."""
_SUBTAXEL = 256
"""Units of a centroid for one taxel."""
_LARGEST_BYTE = 0xFF
_MOST_WAITING = 1000
"""Features that wait to be taken: two seconds of ten pads at 50 Hz; older ones are dropped."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PadFeatures:
    """Features of one pad in one scan.

    Attributes
    ----------
    pad
        Index of the pad in the layout.
    counter
        Frame counter modulo 256.
    active
        Taxels above the touch threshold, at most 255.
    peak_counts
        Largest sample.
    total_counts
        Sum of the samples of the active taxels.
    centroid_row, centroid_column
        Count-weighted centre of the active taxels in taxels, resolution 1/256; 0 without any.
    """

    pad: int
    counter: int
    active: int
    peak_counts: int
    total_counts: int
    centroid_row: float
    centroid_column: float


def pad_features(
    layout: TaxelLayout, counts: NDArray[np.uint16], counter: int, threshold: int
) -> tuple[PadFeatures, ...]:
    """Compute the features of all pads.

    Parameters
    ----------
    layout
        The pads.
    counts : (n_taxels,) uint16
        Samples.
    counter
        Frame counter.
    threshold
        A taxel is active above this many counts.
    """
    if counts.shape != (layout.n_taxels,):
        raise FrameError(f"counts have shape {counts.shape}, expected ({layout.n_taxels},)")
    features = []
    for index, pad in enumerate(layout.pads):
        values = counts[layout.taxels_of(index)].astype(np.int64)
        weights = np.where(values > threshold, values, 0)
        total = int(weights.sum())
        grid = weights.reshape(pad.rows, pad.columns)
        row = float(grid.sum(axis=1) @ np.arange(pad.rows)) / total if total else 0.0
        column = float(grid.sum(axis=0) @ np.arange(pad.columns)) / total if total else 0.0
        features.append(
            PadFeatures(
                pad=index,
                counter=counter & _LARGEST_BYTE,
                active=min(int(np.count_nonzero(weights)), _LARGEST_BYTE),
                peak_counts=int(values.max()),
                total_counts=total,
                centroid_row=round(row * _SUBTAXEL) / _SUBTAXEL,
                centroid_column=round(column * _SUBTAXEL) / _SUBTAXEL,
            )
        )
    return tuple(features)


def encode_features(features: PadFeatures) -> tuple[bytes, bytes]:
    """Return the messages of TPDO2 and TPDO3; FrameError for values that do not fit."""
    if not 0 <= features.pad < MAX_PADS:
        raise FrameError(f"pad is {features.pad}, features can name pads 0 to {MAX_PADS - 1}")
    header = (features.counter % PHASES) << PHASE_SHIFT | features.pad
    try:
        first = _FIRST.pack(header, features.active, features.peak_counts, features.total_counts)
        second = _SECOND.pack(
            header,
            features.counter,
            round(features.centroid_row * _SUBTAXEL),
            round(features.centroid_column * _SUBTAXEL),
        )
    except struct.error as error:
        raise FrameError(f"features of pad {features.pad} do not fit: {error}") from error
    return first, second + crc16(first + second).to_bytes(CRC_BYTES, "little")


def decode_features(first: bytes, second: bytes) -> PadFeatures:
    """Return the features in a pair of messages; FrameError if damaged or not of one scan."""
    if len(first) != MESSAGE_BYTES or len(second) != MESSAGE_BYTES:
        raise FrameError(
            f"feature messages have {len(first)} and {len(second)} bytes, expected {MESSAGE_BYTES}"
        )
    body = second[:-CRC_BYTES]
    found, expected = int.from_bytes(second[-CRC_BYTES:], "little"), crc16(first + body)
    if found != expected:
        raise FrameError(f"feature CRC is 0x{found:04X}, computed 0x{expected:04X}")
    header, active, peak, total = _FIRST.unpack(first)
    header_again, counter, row, column = _SECOND.unpack(body)
    if header != header_again or header >> PHASE_SHIFT != counter % PHASES:
        raise FrameError(
            f"feature messages of different scans: headers 0x{header:02X} and "
            f"0x{header_again:02X}, counter {counter}"
        )
    return PadFeatures(
        pad=header & INDEX_BITS,
        counter=counter,
        active=active,
        peak_counts=peak,
        total_counts=total,
        centroid_row=row / _SUBTAXEL,
        centroid_column=column / _SUBTAXEL,
    )


class FeatureCollector:
    """Collector that pairs the two messages of each pad."""

    def __init__(self) -> None:
        self._first: dict[int, bytes] = {}
        self._features: deque[PadFeatures] = deque(maxlen=_MOST_WAITING)
        self.malformed = 0

    def push_first(self, data: bytes) -> None:
        """Take a message of TPDO2."""
        if len(data) != MESSAGE_BYTES:
            self.malformed += 1
            return
        self._first[data[0] & INDEX_BITS] = data

    def push_second(self, data: bytes) -> PadFeatures | None:
        """Take a message of TPDO3 and return the features that it completes."""
        first = self._first.pop(data[0] & INDEX_BITS, b"") if data else b""
        try:
            features = decode_features(first, data)
        except FrameError:
            self.malformed += 1
            return None
        self._features.append(features)
        return features

    def take(self) -> tuple[PadFeatures, ...]:
        """Return the features since the last call."""
        features = tuple(self._features)
        self._features.clear()
        return features
