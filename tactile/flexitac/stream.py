"""Frames in the byte stream of a FlexiTac board: lock on their header, torn frames. Pure.

A frame is ``AA 55`` and one byte for each taxel, row by row. It has no length, counter or checksum,
and ``AA 55`` may occur inside. So an offset counts only if each frame has a header there.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

HEADER = b"\xaa\x55"
BAUD_RATE = 2_000_000
"""Line rate in bit/s (package ``flexitac`` 0.3.1)."""
PERIOD_S = 0.01
"""Usual period of the frames in s: boards send 85 to 110 frames a second."""
_BURST_SHARE = 0.75
"""Share of the period for the bytes of a frame. They take 2 ms on the line; bytes of the next
frame, a period later, replace lost ones. [chosen]"""
_LOCK_FRAMES = 3
"""Consecutive frames with a header at one offset; noise repeats one in 1 of 65,536. [chosen]"""
_AMBIGUOUS_FRAMES = 20
"""Frames after which several remaining offsets are a static picture, not chance. [chosen]"""


class Profile(NamedTuple):
    """Size of the matrix that a board sends."""

    rows: int
    columns: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame with its header."""
        return len(HEADER) + self.rows * self.columns


PROFILES: Mapping[str, Profile] = MappingProxyType(
    {"12x32": Profile(12, 32), "16x32": Profile(16, 32), "16x16": Profile(16, 16)}
)
"""The sizes of available boards."""


BoardFrame = tuple[float, bytes]
"""One whole frame of a board: monotonic time in s at which its last byte was found, and one byte
for each taxel, row by row."""


class FrameStream:
    """Converts the bytes of one board to its whole frames."""

    def __init__(self, profile: Profile) -> None:
        self._profile = profile
        self._size = profile.frame_bytes
        self.torn = 0
        """Frames that were discarded because the next header was not at its place."""
        self.reset()

    def reset(self) -> None:
        """Discard all bytes and the lock."""
        self._bytes = bytearray()
        self._begun_s = 0.0
        self.locked = False
        """Whether one offset of the header is known."""
        self.trouble = "it sends nothing"
        """Reason for the missing lock."""

    def feed(self, data: bytes, now_s: float) -> list[BoardFrame]:
        """Return the frames completed by these bytes, found at ``now_s`` s, oldest first."""
        if not self._bytes:
            self._begun_s = now_s
        self._bytes += data
        if not self.locked:
            self._find_lock(now_s)
        frames: list[bytes] = []
        while self.locked and len(self._bytes) >= self._size:
            behind = bytes(self._bytes[self._size : self._size + len(HEADER)])
            in_place = self._bytes.startswith(HEADER) and HEADER.startswith(behind)
            if not in_place:
                self.torn += 1
                self.locked = False
                self._find_lock(now_s)
                break
            if not behind and now_s - self._begun_s > _BURST_SHARE * PERIOD_S:
                # It is slow enough to end with a byte of the next frame, whose header will show it.
                break
            frames.append(bytes(self._bytes[len(HEADER) : self._size]))
            del self._bytes[: self._size]
            self._begun_s = now_s
        last = len(frames) - 1
        return [(now_s - (last - n) * PERIOD_S, samples) for n, samples in enumerate(frames)]

    def _find_lock(self, now_s: float) -> None:
        """Lock if exactly one offset has a header in each of several frames."""
        n_frames = (len(self._bytes) - 1) // self._size
        if n_frames < _LOCK_FRAMES:
            return
        offsets = _offsets(self._bytes, self._size, n_frames)
        if len(offsets) == 1:
            # The time of bytes before the newest frames is unknown.
            del self._bytes[: offsets[0] + (n_frames - 1) * self._size]
            self._begun_s, self.locked, self.trouble = now_s, True, ""
            return
        if offsets and n_frames < _AMBIGUOUS_FRAMES:
            return
        self.trouble = (
            f"its stream is ambiguous: AA 55 is at {len(offsets)} places of each frame, for "
            "example under a static load: take the load off the pad"
            if offsets
            else self._no_header()
        )
        del self._bytes[: self._size]

    def _no_header(self) -> str:
        """Return why no offset has a header in each frame: another profile, or damage."""
        for name, other in PROFILES.items():
            n_frames = (len(self._bytes) - 1) // other.frame_bytes
            repeats = n_frames > 1 and _offsets(self._bytes, other.frame_bytes, n_frames)
            if other != self._profile and repeats:
                return f"its frames are {name}: set tactile.sensor.profile to that"
        return f"no header repeats every {self._size} bytes: check its cable and its firmware"


def _offsets(data: bytearray, size: int, n_frames: int) -> list[int]:
    """Return each offset below ``size`` with a header in all of ``n_frames`` frames."""
    at = np.frombuffer(data, np.uint8, n_frames * size + 1)
    headers = (at[:-1] == HEADER[0]) & (at[1:] == HEADER[1])
    return np.flatnonzero(headers.reshape(n_frames, size).all(axis=0)).tolist()
