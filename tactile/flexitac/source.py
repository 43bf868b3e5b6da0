"""Frame source of two FlexiTac boards: one on each finger, each on a serial port of its own.

The boards run freely and send neither counter nor checksum. Only header, content and time show a
torn, repeated or late frame.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

from tactile.board_source import Board, PolledBoards
from tactile.errors import LayoutError
from tactile.flexitac.stream import PERIOD_S, FrameStream, Profile
from tactile.layout import TaxelLayout
from tactile.source import FrameStatistics, TactileFrame

_READ_BYTES = 65536
_STALL_PERIODS = 6.0
"""Periods after which unread bytes are dropped: a port keeps 4,096 bytes, without their times.
[chosen]"""
_LIVELY_FRAMES, _LIVELY_SHARE = 25, 0.9
"""Newest frames, and the share of them that must differ from the previous one. Then an equal frame
is a repeat, because the noise of hundreds of taxels does not repeat itself. [chosen]"""


class BoardLine(Protocol):
    """Serial line of a board."""

    def read(self, size: int, timeout_s: float, /) -> bytes:
        """Return 1 to ``size`` bytes as soon as one is available, b"" after ``timeout_s`` s."""

    def close(self) -> None:
        """Close the line; may be called twice."""


class _Board(Board):
    """One board: the frames in its bytes."""

    def __init__(self, finger: int, profile: Profile, *, rows_along: bool) -> None:
        self.stream = FrameStream(profile)
        self._shape, self._rows_along = profile, rows_along
        self._changes: deque[bool] = deque(maxlen=_LIVELY_FRAMES)
        super().__init__(f"the board of finger {finger}")

    def restart(self, now_s: float) -> None:
        """Discard all frames at the start of the source."""
        super().restart(now_s)
        self.stream.reset()
        self._changes.clear()
        self._samples, self._repeated = b"", False

    @property
    def trouble(self) -> str:
        """Reason of its silence and next step."""
        why = "it repeats one frame" if self._repeated else self.stream.trouble
        return why or super().trouble

    def receive(
        self, line: BoardLine, now_s: float, statistics: FrameStatistics, *, stalled: bool
    ) -> None:
        """Receive the available bytes of its line."""
        data = b""
        while piece := line.read(_READ_BYTES, 0.0):
            data += piece
        if stalled:
            self.stream.reset()
            self.waiting.clear()
            # The board may be silent until the stream has locked again.
            self.last_s = now_s
            return
        torn = self.stream.torn
        frames = self.stream.feed(data, now_s)
        if self.stream.torn > torn:
            statistics.torn += 1
            self.sound.append(False)
        for t_s, samples in frames:
            self._take(t_s, samples, statistics)

    def _take(self, t_s: float, samples: bytes, statistics: FrameStatistics) -> None:
        same = samples == self._samples
        lively = sum(self._changes) >= _LIVELY_SHARE * _LIVELY_FRAMES
        # A pad at an end of its scale, or without supply, has no noise.
        self._repeated = same and lively and len(set(samples)) > 1
        if self._repeated:
            statistics.duplicate += 1
            return
        self._changes.append(not same)
        self._samples = samples
        matrix = np.frombuffer(samples, dtype=np.uint8).reshape(self._shape)
        pad = (matrix if self._rows_along else matrix.T).astype(np.uint16).ravel()
        # A board scans and sends without a pause: the mean of its taxels is half a period older.
        self.saw(t_s - 0.5 * PERIOD_S, t_s, pad)


def check_layout(layout: TaxelLayout, profile: Profile, *, rows_along: bool) -> None:
    """Raise LayoutError where a layout has other pads than two of the profile's size."""
    wanted = profile if rows_along else profile[::-1]
    if [(pad.rows, pad.columns) for pad in layout.pads] != [wanted, wanted]:
        raise LayoutError(
            f"layout {layout.name} does not fit two boards of {profile.rows} x {profile.columns}: "
            f"it needs two inner pads of {wanted[0]} rows along the finger and {wanted[1]} columns "
            "across it"
        )


class FlexiTacSource(PolledBoards[_Board]):
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
        boards = [_Board(finger, profile, rows_along=rows_along) for finger in (0, 1)]
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
                board.receive(line, now_s, self._counts.frames, stalled=stalled)
        return self._new_frames()

    def close(self) -> None:
        """Close the lines."""
        for line in self._lines:
            line.close()
        self._lines.clear()
