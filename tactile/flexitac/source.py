"""Frame source of two FlexiTac boards: one on each finger, each on a serial port of its own.

The boards run freely and send neither counter nor checksum. Only header, content and time show a
torn, repeated or late frame.
"""

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tactile.board_source import PolledBoards
from tactile.errors import FrameTimeout, LayoutError, LinkFault, LinkStateError, NodeMissing
from tactile.flexitac.stream import PERIOD_S, BoardFrame, FrameStream, Profile
from tactile.layout import TaxelLayout
from tactile.source import FrameStatistics, SourceIdentity, SourceStatistics, TactileFrame

_READ_BYTES = 65536
_STALL_PERIODS = 6.0
"""Periods after which unread bytes are dropped: a port keeps 4,096 bytes, without their times.
[chosen]"""
_LOSS_FRAMES = 50
"""Number of newest frames for the loss rate."""
_LIVELY_FRAMES, _LIVELY_SHARE = 25, 0.9
"""Newest frames, and the share of them that must differ from the previous one. Then an equal frame
is a repeat, because the noise of hundreds of taxels does not repeat itself. [chosen]"""


class BoardLine(Protocol):
    """Serial line of a board."""

    def read(self, size: int, timeout_s: float, /) -> bytes:
        """Return 1 to ``size`` bytes as soon as one is available, b"" after ``timeout_s`` s."""

    def close(self) -> None:
        """Close the line; may be called twice."""


class _Board:
    """One board: its line, its frames that wait for the other board, and its frame statistics."""

    def __init__(self, finger: int, open_line: Callable[[], BoardLine], profile: Profile) -> None:
        self.name = f"the board of finger {finger}"
        self._open_line = open_line
        self._line: BoardLine | None = None
        self.stream = FrameStream(profile)
        self.waiting: list[BoardFrame] = []
        self.last: BoardFrame | None = None
        self.changes: deque[bool] = deque(maxlen=_LIVELY_FRAMES)
        self.sound: deque[bool] = deque(maxlen=_LOSS_FRAMES)
        self.repeated = False

    def open(self) -> None:
        """Open the line anew."""
        self.close()
        self._line = self._open_line()
        self.stream.reset()
        self.waiting.clear()
        self.changes.clear()
        self.sound.clear()
        self.last, self.repeated = None, False

    def close(self) -> None:
        """Close the line."""
        if self._line is not None:
            self._line.close()
            self._line = None

    def receive(self, now_s: float, statistics: FrameStatistics, *, stalled: bool) -> None:
        """Receive the available bytes."""
        if self._line is None:
            raise LinkStateError("the line of the sensor is closed: start it first")
        data = b""
        while piece := self._line.read(_READ_BYTES, 0.0):
            data += piece
        if stalled:
            self.stream.reset()
            self.waiting.clear()
            return
        torn = self.stream.torn
        frames = self.stream.feed(data, now_s)
        if self.stream.torn > torn:
            statistics.torn += 1
            self.sound.append(False)
        for frame in frames:
            self._take(frame, statistics)

    def _take(self, frame: BoardFrame, statistics: FrameStatistics) -> None:
        same = self.last is not None and frame.samples == self.last.samples
        lively = sum(self.changes) >= _LIVELY_SHARE * _LIVELY_FRAMES
        # A pad at an end of its scale, or without supply, has no noise.
        self.repeated = same and lively and len(set(frame.samples)) > 1
        if self.repeated:
            statistics.duplicate += 1
            return
        self.changes.append(not same)
        self.sound.append(True)
        self.last = frame
        self.waiting.append(frame)

    @property
    def loss_rate(self) -> float:
        """Share of the newest frames that were torn."""
        return 1.0 - sum(self.sound) / _LOSS_FRAMES if len(self.sound) == _LOSS_FRAMES else 0.0


def check_layout(layout: TaxelLayout, profile: Profile, *, rows_along: bool) -> None:
    """Raise LayoutError where a layout has other pads than two of the profile's size."""
    shape = (profile.rows, profile.columns)
    wanted = shape if rows_along else shape[::-1]
    if [(pad.rows, pad.columns) for pad in layout.pads] != [wanted, wanted]:
        raise LayoutError(
            f"layout {layout.name} does not fit two boards of {shape[0]} x {shape[1]}: it needs "
            f"two inner pads of {wanted[0]} rows along the finger and {wanted[1]} columns across it"
        )


class FlexiTacSource(PolledBoards):
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
    line_errors
        Errors of a line that cannot be opened or is gone.
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
        line_errors: tuple[type[Exception], ...] = (OSError,),
        **options: Any,
    ) -> None:
        check_layout(layout, profile, rows_along=rows_along)
        super().__init__(layout=layout, period_s=PERIOD_S, **options)
        self._profile, self._transposed = profile, not rows_along
        self._line_errors = line_errors
        self._boards = [_Board(n, line, profile) for n, line in enumerate(open_lines)]
        self._polled_s = 0.0

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the last start."""
        loss = max(board.loss_rate for board in self._boards)
        return SourceStatistics(frames=self._frames, recent_loss_rate=loss)

    def start(self) -> SourceIdentity:
        """Open both lines and wait for a frame of both boards.

        Raises NodeMissing if a line cannot be opened, and FrameTimeout if a board sends no frames.
        """
        self._fault, self._frames, self._running = None, FrameStatistics(), True
        try:
            for board in self._boards:
                board.open()
        except self._line_errors as error:
            self.stop()
            raise NodeMissing(f"{board.name} cannot be opened: {error}") from error
        self._polled_s = began_s = self.clock.monotonic()
        while missing := [board for board in self._boards if board.last is None]:
            if self.clock.monotonic() - began_s > self._startup_s:
                self.stop()
                raise FrameTimeout(
                    f"{missing[0].name} sent no frame of {self._profile.rows} x "
                    f"{self._profile.columns} within {self._startup_s:g} s: "
                    f"{missing[0].stream.trouble}"
                )
            self.clock.sleep(0.1 * PERIOD_S)
            self._receive()
        return SourceIdentity(name="FlexiTac")

    def _look(self) -> list[TactileFrame]:
        self._receive()
        self._check()
        n = min(len(board.waiting) for board in self._boards)
        newest = (board.waiting[len(board.waiting) - n :] for board in self._boards)
        pairs = list(zip(*newest, strict=True))
        for board in self._boards:
            # Without a frame of the other board its newest frame waits.
            board.waiting = [] if n else board.waiting[-1:]
        return [self._frame_of(pair) for pair in pairs]

    def _receive(self) -> None:
        now_s = self.clock.monotonic()
        stalled = now_s - self._polled_s > _STALL_PERIODS * PERIOD_S
        if stalled:
            self._frames.lost += int((now_s - self._polled_s) / PERIOD_S)
        self._polled_s = now_s
        for board in self._boards:
            try:
                board.receive(now_s, self._frames, stalled=stalled)
            except self._line_errors as error:
                raise LinkFault(f"the line of {board.name} is gone: {error}") from error
            if stalled and board.last is not None:
                # The board may be silent until the stream has locked again.
                board.last = BoardFrame(t_s=now_s, samples=board.last.samples)

    def _check(self) -> None:
        """Raise the fault of a board that is silent, frozen or damaged."""
        now_s = self.clock.monotonic()
        for board in self._boards:
            silent_s = now_s - (board.last.t_s if board.last is not None else self._polled_s)
            if silent_s > self._silence_s:
                why = "it repeats one frame" if board.repeated else board.stream.trouble
                raise FrameTimeout(
                    f"{board.name} has sent no new frame for {silent_s:.3f} s, allowed are "
                    f"{self._silence_s:g} s: {why or 'check its cable and supply'}"
                )
            if board.loss_rate > self._max_loss_rate:
                raise FrameTimeout(
                    f"{board.loss_rate:.0%} of the last {_LOSS_FRAMES} frames of {board.name} were "
                    f"torn, allowed are {self._max_loss_rate:.0%} (tactile.loss_max_share): check "
                    "its cable and what else loads the computer"
                )

    def _frame_of(self, pair: Sequence[BoardFrame]) -> TactileFrame:
        pads = [self._pad(pair[pad.finger].samples) for pad in self.layout.pads]
        times_s = [board.t_s for board in pair]
        return self._frame(np.concatenate(pads), min(times_s), max(times_s))

    def _pad(self, samples: bytes) -> NDArray[np.uint16]:
        matrix = np.frombuffer(samples, dtype=np.uint8).reshape(
            self._profile.rows, self._profile.columns
        )
        return (matrix.T if self._transposed else matrix).astype(np.uint16).ravel()

    def stop(self) -> None:
        """Close the lines."""
        self._running = False
        for board in self._boards:
            board.close()
