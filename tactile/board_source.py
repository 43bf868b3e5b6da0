"""Bases of the frame sources of boards without forces, independent of their bytes."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile.clock import Clock
from tactile.errors import FrameTimeout, LinkFault, NodeMissing
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.source import (
    COUNTER_MASK,
    Arrivals,
    FrameStatistics,
    LatchingSource,
    PadZero,
    ScanStatus,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)

_LOSS_FRAMES = 200
"""Number of newest frames for the loss rate: with 1 % of loss it hardly exceeds 5 % by chance."""
_LIVELY_FRAMES, _LIVELY_SHARE = 25, 0.9
"""Newest frames, and the share of them that must differ from the previous one. Then an equal frame
is a repeat, because the noise of many taxels does not repeat itself. [chosen]"""
_WAIT_SHARE = 0.1
"""Share of the period between two checks for the first frame."""
BoardSamples = tuple[float, float, NDArray[np.uint16]]
"""Times in s of the first and the last byte of a board's frame, and its samples: (n,) counts, or
(n, k) with the counts first and further samples that are only recorded."""


class Board:
    """One board of a source: its newest frames, and the share of damaged ones.

    Parameters
    ----------
    streams
        Whether it sends each scan once. Then two equal frames may be two scans of a quiet pad. A
        board that is asked sends a scan again until the next one.
    """

    def __init__(self, name: str, n_frames: int = _LOSS_FRAMES, *, streams: bool = True) -> None:
        self.name, self._streams = name, streams
        self.ended: deque[tuple[float, bool]] = deque(maxlen=n_frames)
        """Time in s of the end of each of its newest frames, and whether it was whole."""
        self.waiting: list[BoardSamples] = []
        """Its new frames that wait for those of the other boards."""
        self._changes: deque[bool] = deque(maxlen=_LIVELY_FRAMES)
        self.restart(0.0, FrameStatistics())

    def restart(self, now_s: float, counts: FrameStatistics) -> None:
        """Discard all frames at the start of the source, whose counts are updated from now on."""
        self.ended.clear()
        self.waiting.clear()
        self._changes.clear()
        self.last_s, self.seen, self.counts = now_s, False, counts
        self._last, self._repeated = np.zeros(0, dtype=np.uint16), False

    def saw(self, begun_s: float, t_s: float, samples: NDArray[np.uint16]) -> None:
        """Add a whole frame; a repeated one is dropped and counted."""
        same = np.array_equal(samples, self._last)
        lively = not self._streams or sum(self._changes) >= _LIVELY_SHARE * _LIVELY_FRAMES
        # A pad at an end of its scale, or without supply, has no noise.
        self._repeated = same and lively and bool((samples != samples[0]).any())
        if self._repeated:
            self.counts.duplicate += 1
            return
        # Late frames come in a burst, whose times go back beyond that of a frame before.
        t_s = max(t_s, self.last_s)
        self._changes.append(not same)
        self.ended.append((t_s, True))
        self._last, self.last_s, self.seen = samples, t_s, True
        self.waiting.append((begun_s, t_s, samples))

    def tore(self, t_s: float) -> None:
        """Count a damaged frame."""
        self.counts.torn += 1
        self.ended.append((t_s, False))

    @property
    def loss_rate(self) -> float:
        """Share of its newest frames that were damaged; 0 until there are enough."""
        n = len(self.ended)
        return sum(not whole for _, whole in self.ended) / n if n == self.ended.maxlen else 0.0

    @property
    def trouble(self) -> str:
        """Reason of its silence and next step."""
        return "it repeats one frame" if self._repeated else "check its cable and supply"


_Board = TypeVar("_Board", bound=Board)


class PolledBoards(LatchingSource, ABC, Generic[_Board]):
    """Common part of `tactile.source.FrameSource` for boards without forces.

    It latches faults, detects silence and loss, and makes numbered frames of the samples of both
    pads.

    Parameters
    ----------
    name
        Name of the device, for people.
    boards
        Its boards.
    period_s
        Usual time between two frames in s.
    line_errors
        Errors of a line that cannot be opened or is gone.
    mounts
        Pads mounted differently than in the layout.
    silence_s, max_loss_rate, startup_timeout_s
        Limits for a fault: silence in s, share of damaged frames and time of the start in s.
    """

    silent_periods = 8.0
    """Least silence without a new frame that is a fault, in periods. [chosen]"""
    unit = "new frame"
    """What each board sends, for messages."""

    def __init__(
        self,
        name: str,
        boards: Sequence[_Board],
        *,
        layout: TaxelLayout,
        clock: Clock,
        period_s: float,
        line_errors: tuple[type[Exception], ...] = (OSError,),
        mounts: Sequence[PadMount] = (),
        silence_s: float = 0.0,
        max_loss_rate: float = 0.05,
        startup_timeout_s: float = 3.0,
    ) -> None:
        super().__init__()
        self._name, self._boards, self._line_errors = name, boards, line_errors
        self.layout, self.clock, self.period_s = layout, clock, period_s
        self._order = taxel_order(layout, mounts)
        self._silence_s = max(silence_s, self.silent_periods * period_s)
        self._max_loss_rate, self._startup_s = max_loss_rate, startup_timeout_s
        self._counts = SourceStatistics()

    @abstractmethod
    def open(self) -> None:
        """Open the lines and request frames; may raise a line error or LinkFault."""

    @abstractmethod
    def _receive(self) -> Sequence[TactileFrame]:
        """Return the frames since the last call, and update the boards; may raise LinkFault."""

    @abstractmethod
    def close(self) -> None:
        """Close the lines; may be called twice, and before `open`."""

    def _absent(self, board: _Board) -> str:
        """Return what was not received of a board at the start."""
        return f"{board.name} sent no {self.unit} within {self._startup_s:g} s: {board.trouble}"

    @contextmanager
    def _line_of(self, name: str) -> Iterator[None]:
        """Convert the errors of a board's line."""
        try:
            yield
        except self._line_errors as error:
            if self._running:
                raise LinkFault(f"the line of {name} is gone: {error}") from error
            raise NodeMissing(f"the line of {name} cannot be opened: {error}") from error

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the last start."""
        loss_rate = max(board.loss_rate for board in self._boards)
        return self._counts.copied(recent_loss_rate=loss_rate)

    def start(self) -> SourceIdentity:
        """Open the lines and wait for a frame of each board.

        Raises NodeMissing if a line cannot be opened, and FrameTimeout if a board sends no frames.
        """
        self.stop()
        self._counts = SourceStatistics()
        began_s = self.clock.monotonic()
        for board in self._boards:
            board.restart(began_s, self._counts.frames)
        try:
            with self._line_of(self._name):
                self.open()
            self.fault = None
            while absent := [board for board in self._boards if not board.seen]:
                if self.clock.monotonic() - began_s > self._startup_s:
                    raise FrameTimeout(self._absent(absent[0]))
                self.clock.sleep(_WAIT_SHARE * self.period_s)
                self._receive()
        except BaseException as error:
            if isinstance(error, LinkFault):
                self.fault = error  # the next start opens a lost line again
            self.stop()
            raise
        self._running = True
        return SourceIdentity(name=self._name)

    def poll(self) -> Arrivals:
        """Return the frames since the last call; does not wait."""
        return self._guarded(self._poll)

    def _poll(self) -> Arrivals:
        frames = self._receive()
        for board in self._boards:
            self._check(board)
        return Arrivals(tuple(frames))

    def _check(self, board: Board) -> None:
        """Raise the fault of a board that is silent or damaged."""
        silent_s = self.clock.monotonic() - board.last_s
        if silent_s > self._silence_s:
            raise FrameTimeout(
                f"{board.name} has sent no {self.unit} for {silent_s:.3f} s, allowed are "
                f"{self._silence_s:g} s: {board.trouble}"
            )
        if board.loss_rate > self._max_loss_rate:
            raise FrameTimeout(
                f"{board.loss_rate:.0%} of the last {board.ended.maxlen} frames of {board.name} "
                f"were damaged, allowed are {self._max_loss_rate:.0%} (tactile.loss_max_share): "
                "check its cable, and what else loads its line and the computer"
            )

    def _new_frames(self) -> list[TactileFrame]:
        """Return the frames for which all boards have samples.

        Without samples of another board the newest of a board wait.
        """
        n = min(len(board.waiting) for board in self._boards)
        newest = [board.waiting[len(board.waiting) - n :] for board in self._boards]
        for board in self._boards:
            board.waiting = [] if n else board.waiting[-1:]
        return [self._frame(parts) for parts in zip(*newest, strict=True)]

    def _frame(self, parts: Sequence[BoardSamples]) -> TactileFrame:
        """Return the next frame: the samples of one board for all pads, or of one for each."""
        begun_s, ends_s, samples = zip(*parts, strict=True)
        by_pad = [samples[pad.finger] for pad in self.layout.pads] if len(parts) > 1 else samples
        whole = np.concatenate(by_pad).reshape(self.layout.n_taxels, -1)[self._order]
        counts, extra = whole[:, 0].copy(), whole[:, 1:]
        counts.setflags(write=False)
        self._counts.frames.complete += 1
        full = ScanStatus.SATURATED if counts.max() >= self.layout.adc_max else 0
        return TactileFrame(
            t_s=max(ends_s),
            begun_s=min(begun_s),
            counter=self._counts.frames.complete & COUNTER_MASK,
            status=int(full),
            counts=counts,
            extra=extra if extra.size else None,
        )

    def set_zero(self, zero: PadZero) -> None:
        """Do nothing: the boards send no forces."""

    def stop(self) -> None:
        """Close the lines."""
        self._running = False
        self.close()


class BoardSource(PolledBoards[Board]):
    """Implements `tactile.source.FrameSource` with `open`, `receive` and `close` of a subclass.

    It latches faults, numbers frames, removes repeated ones, and detects silence and loss.

    Parameters
    ----------
    name
        Name of the device, for people.
    options
        Further arguments of `PolledBoards`.
    """

    def __init__(self, name: str, **options: Any) -> None:
        self._board = Board(name, streams=False)
        super().__init__(name, (self._board,), **options)

    @abstractmethod
    def receive(self, now_s: float) -> Sequence[tuple[float, NDArray[np.uint16]]]:
        """Receive the available bytes without waiting; calls `damaged` for each unusable frame.

        Returns
        -------
        For each frame now whole, oldest first: the start of its scan in s, and the samples
        (n_taxels,) uint16, pad by pad in the order of the layout.
        """

    def damaged(self) -> None:
        """Count an unusable frame."""
        self._counts.frames.corrupt += 1
        self._board.ended.append((self.clock.monotonic(), False))

    def _receive(self) -> Sequence[TactileFrame]:
        now_s = self.clock.monotonic()
        with self._line_of(self._name):
            received = self.receive(now_s)
        for begun_s, samples in received:
            self._board.saw(begun_s, now_s, samples)
        return self._new_frames()
