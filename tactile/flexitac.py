"""FlexiTac: a resistive matrix on each finger, whose board sends its frames over USB serial.

The boards run freely and send neither counter nor checksum. Only header, content and time show a
torn, repeated or late frame. A frame is ``AA 55`` and one byte for each taxel, row by row. It has
no length, and ``AA 55`` may occur inside. So an offset counts only if each frame has a header
there.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from tactile.board_source import Board, PolledBoards
from tactile.errors import LayoutError
from tactile.layout import TaxelLayout
from tactile.source import FrameStatistics, TactileFrame

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
_READ_BYTES = 65536
_STALL_PERIODS = 6.0
"""Periods after which unread bytes are dropped: a port keeps 4,096 bytes, without their times.
[chosen]"""


class Profile(NamedTuple):
    """Size of the matrix that a board sends."""

    rows: int
    columns: int

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame with its header."""
        return len(HEADER) + self.rows * self.columns


PROFILES: Mapping[str, Profile] = {
    "12x32": Profile(12, 32),
    "16x32": Profile(16, 32),
    "16x16": Profile(16, 16),
}
"""The sizes of available boards."""


class BoardLine(Protocol):
    """Serial line of a board."""

    def read(self, size: int, timeout_s: float, /) -> bytes:
        """Return 1 to ``size`` bytes as soon as one is available, b"" after ``timeout_s`` s."""

    def close(self) -> None:
        """Close the line; may be called twice."""


class FlexiTacBoard(Board):
    """One board: converts its bytes to whole frames.

    Parameters
    ----------
    finger, profile
        Finger of its pad, and the pad's size.
    rows_along
        Whether the rows of a frame lie along the finger.
    """

    def __init__(self, finger: int, profile: Profile, *, rows_along: bool) -> None:
        self._profile, self._rows_along = profile, rows_along
        self._size = profile.frame_bytes
        super().__init__(f"the board of finger {finger}")

    def restart(self, now_s: float, counts: FrameStatistics) -> None:
        """Discard all frames at the start of the source."""
        super().restart(now_s, counts)
        self._unlock()

    def _unlock(self) -> None:
        """Discard all bytes and the lock."""
        self._bytes = bytearray()
        self._begun_s = 0.0
        self.locked = False
        """Whether one offset of the header is known."""
        self._unlocked_by = "it sends nothing"
        """Reason for the missing lock; empty with a lock."""

    @property
    def trouble(self) -> str:
        """Reason of its silence and next step."""
        return self._unlocked_by or super().trouble

    def receive(self, line: BoardLine, now_s: float, *, stalled: bool) -> None:
        """Receive the available bytes of its line."""
        data = b""
        while piece := line.read(_READ_BYTES, 0.0):
            data += piece
        if stalled:
            self._unlock()
            self.waiting.clear()
            # The board may be silent until the stream has locked again.
            self.last_s = now_s
            return
        for t_s, samples in self.feed(data, now_s):
            matrix = np.frombuffer(samples, dtype=np.uint8).reshape(self._profile)
            pad = (matrix if self._rows_along else matrix.T).astype(np.uint16).ravel()
            # A board scans and sends without a pause: its mean taxel is half a period older.
            self.saw(t_s - 0.5 * PERIOD_S, t_s, pad)

    def feed(self, data: bytes, now_s: float) -> list[tuple[float, bytes]]:
        """Return the frames completed by these bytes, found at ``now_s`` s, oldest first.

        Each is the monotonic time in s at which its last byte was found, and one byte for each
        taxel, row by row.
        """
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
                self.tore(now_s)
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
            self._begun_s, self.locked, self._unlocked_by = now_s, True, ""
            return
        if offsets and n_frames < _AMBIGUOUS_FRAMES:
            return
        self._unlocked_by = (
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


def check_layout(layout: TaxelLayout, profile: Profile, *, rows_along: bool) -> None:
    """Raise LayoutError where a layout has other pads than two of the profile's size."""
    size = profile if rows_along else profile[::-1]
    if [(pad.rows, pad.columns) for pad in layout.pads] != [size, size]:
        raise LayoutError(
            f"layout {layout.name} does not fit two boards of {profile.rows} x {profile.columns}: "
            f"it needs two inner pads of {size[0]} rows along the finger and {size[1]} columns "
            "across it"
        )


class FlexiTacSource(PolledBoards[FlexiTacBoard]):
    """Two FlexiTac boards; implements `tactile.source.FrameSource`.

    A frame consists of the newest frames of both boards, as soon as both have a new one. Raises
    LayoutError where the layout has other pads than two of the profile's size.

    Parameters
    ----------
    open_lines
        Open the serial line of the board on finger 0 and on finger 1; called at each start.
    profile
        Size of the matrix that both boards send.
    rows_along
        Whether the rows of a board follow each other along the finger; otherwise across it.
    options
        Further arguments of `PolledBoards`.
    """

    def __init__(
        self,
        open_lines: Sequence[Callable[[], BoardLine]],
        *,
        profile: Profile,
        layout: TaxelLayout,
        rows_along: bool = False,
        **options: Any,
    ) -> None:
        check_layout(layout, profile, rows_along=rows_along)
        boards = [FlexiTacBoard(finger, profile, rows_along=rows_along) for finger in (0, 1)]
        super().__init__("FlexiTac", boards, layout=layout, period_s=PERIOD_S, **options)
        self.unit = f"new frame of {profile.rows} x {profile.columns}"
        self._open_lines = open_lines
        self._lines: list[BoardLine] = []
        self._polled_s = 0.0

    def open(self) -> None:
        """Open the lines."""
        for board, open_line in zip(self._boards, self._open_lines, strict=True):
            with self._line_of(board.name):
                self._lines.append(open_line())
        self._polled_s = self.clock.monotonic()

    def _receive(self) -> list[TactileFrame]:
        now_s = self.clock.monotonic()
        stalled = now_s - self._polled_s > _STALL_PERIODS * PERIOD_S
        if stalled:
            self._counts.frames.lost += int((now_s - self._polled_s) / PERIOD_S)
        self._polled_s = now_s
        for board, line in zip(self._boards, self._lines, strict=True):
            with self._line_of(board.name):
                board.receive(line, now_s, stalled=stalled)
        return self._new_frames()

    def close(self) -> None:
        """Close the lines."""
        for line in self._lines:
            line.close()
        self._lines.clear()
