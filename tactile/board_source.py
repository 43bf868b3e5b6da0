"""Bases of the frame sources of boards without forces, independent of their bytes."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile.clock import Clock
from tactile.errors import FrameTimeout, LinkFault, LinkStateError, NodeMissing
from tactile.layout import PadMount, TaxelLayout, taxel_order
from tactile.source import (
    Arrivals,
    FrameStatistics,
    FrameStatus,
    PadZero,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)

_LOSS_FRAMES = 50
"""Number of newest frames for the loss rate."""
_WAIT_SHARE = 0.1
"""Share of the period between two checks for the first frame."""


class PolledBoards(ABC):
    """Common part of `tactile.source.FrameSource` for boards without forces.

    It latches faults, and makes numbered frames of the samples of both pads.

    Parameters
    ----------
    period_s
        Usual time between two frames in s.
    mounts
        Pads mounted differently than in the layout.
    silence_s, max_loss_rate, startup_timeout_s
        Limits for a fault: silence in s, share of damaged frames and time of the start in s.
    """

    sends_forces = False
    silent_periods = 8.0
    """Least silence without a new frame that is a fault, in periods. [chosen]"""

    def __init__(
        self,
        *,
        layout: TaxelLayout,
        clock: Clock,
        period_s: float,
        mounts: Sequence[PadMount] = (),
        silence_s: float = 0.0,
        max_loss_rate: float = 0.05,
        startup_timeout_s: float = 3.0,
    ) -> None:
        self.layout, self.clock, self.period_s = layout, clock, period_s
        self._order = taxel_order(layout, mounts)
        self._silence_s = max(silence_s, self.silent_periods * period_s)
        self._max_loss_rate, self._startup_s = max_loss_rate, startup_timeout_s
        self._frames = FrameStatistics()
        self._fault: LinkFault | None = None
        self._running = False

    @abstractmethod
    def _look(self) -> Sequence[TactileFrame]:
        """Return the frames since the last call; raises LinkFault."""

    def poll(self) -> Arrivals:
        """Return the frames since the last call; does not wait."""
        if self._fault is not None:
            raise self._fault
        if not self._running:
            raise LinkStateError("the sensor is not running: start it first")
        try:
            return Arrivals(tuple(self._look()))
        except LinkFault as fault:
            self._fault = fault
            raise

    def _frame(
        self,
        samples: NDArray[np.uint16],
        begun_s: float,
        t_s: float,
        extra: NDArray[np.uint16] | None = None,
    ) -> TactileFrame:
        """Return the next frame of samples, pad by pad in the order of the layout.

        ``extra``: (n_taxels, k) uint16, further samples of each taxel to be recorded.
        """
        counts = samples[self._order]
        counts.setflags(write=False)
        extra = None if extra is None else extra[self._order]
        self._frames.complete += 1
        full = FrameStatus.SATURATED if counts.max() >= self.layout.adc_max else 0
        counter = self._frames.complete & 0xFFFF
        return TactileFrame(
            t_s=t_s,
            begun_s=begun_s,
            counter=counter,
            status=int(full),
            counts=counts,
            extra=extra,
        )

    def set_zero(self, zero: PadZero) -> None:  # noqa: B027
        """Do nothing: the boards send no forces."""


class BoardSource(PolledBoards):
    """Implements `tactile.source.FrameSource` with `open`, `receive` and `close` of a subclass.

    It latches faults, numbers frames, removes repeated ones, and detects silence and loss.

    Parameters
    ----------
    name
        Name of the device, for people.
    line_errors
        Errors of a line that cannot be opened or is gone.
    options
        Further arguments of `PolledBoards`.
    """

    def __init__(
        self, name: str, *, line_errors: tuple[type[Exception], ...] = (OSError,), **options: Any
    ) -> None:
        super().__init__(**options)
        self._name, self._line_errors = name, line_errors
        self._reset()

    def _reset(self) -> None:
        self._frames = FrameStatistics()
        self._sound: deque[bool] = deque(maxlen=_LOSS_FRAMES)
        self._last: NDArray[np.uint16] | None = None
        self._new_s = self.clock.monotonic()

    @abstractmethod
    def open(self) -> None:
        """Open the lines and request frames; may raise a line error or LinkFault."""

    @abstractmethod
    def receive(self, now_s: float) -> Sequence[tuple[float, NDArray[np.uint16]]]:
        """Receive the available bytes without waiting; calls `damaged` for each unusable frame.

        Returns
        -------
        For each frame now whole, oldest first: the start of its scan in s, and the samples
        (n_taxels,) uint16, pad by pad in the order of the layout.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the lines; may be called twice, and before `open`."""

    def damaged(self) -> None:
        """Count an unusable frame."""
        self._frames.corrupt += 1
        self._sound.append(False)

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the last start."""
        full = len(self._sound) == _LOSS_FRAMES
        loss = 1.0 - sum(self._sound) / _LOSS_FRAMES if full else 0.0
        return SourceStatistics(frames=self._frames, recent_loss_rate=loss)

    def start(self) -> SourceIdentity:
        """Open the lines and wait for a frame; raises NodeMissing or FrameTimeout."""
        self.stop()
        self._reset()
        try:
            self.open()
            while self._last is None:
                if self.clock.monotonic() - self._new_s > self._startup_s:
                    raise FrameTimeout(
                        f"{self._name} sent no whole frame within {self._startup_s:g} s: check "
                        "cable, supply and address"
                    )
                self.clock.sleep(_WAIT_SHARE * self.period_s)
                self._take()
        except self._line_errors as error:
            self.close()
            raise NodeMissing(f"the line of {self._name} cannot be opened: {error}") from error
        except BaseException:
            self.close()
            raise
        self._running = True
        return SourceIdentity(name=self._name)

    def _look(self) -> Sequence[TactileFrame]:
        try:
            frames = self._take()
        except self._line_errors as error:
            raise LinkFault(f"the line of {self._name} is gone: {error}") from error
        self._check()
        return frames

    def _take(self) -> list[TactileFrame]:
        now_s = self.clock.monotonic()
        frames = [
            self._frame(samples, begun_s, now_s)
            for begun_s, samples in self.receive(now_s)
            if self._is_new(samples)
        ]
        if frames:
            self._new_s = now_s
        return frames

    def _is_new(self, samples: NDArray[np.uint16]) -> bool:
        """Return whether a frame differs from the last one: noise does not repeat itself."""
        if self._last is not None and np.array_equal(samples, self._last):
            self._frames.duplicate += 1
            return False
        self._last = samples
        self._sound.append(True)
        return True

    def _check(self) -> None:
        silent_s = self.clock.monotonic() - self._new_s
        if silent_s > self._silence_s:
            raise FrameTimeout(
                f"{self._name} has sent no new frame for {silent_s:.3f} s, allowed are "
                f"{self._silence_s:g} s: check cable and supply"
            )
        loss = self.statistics.recent_loss_rate
        if loss > self._max_loss_rate:
            raise FrameTimeout(
                f"{loss:.0%} of the last {_LOSS_FRAMES} frames of {self._name} were damaged, "
                f"allowed are {self._max_loss_rate:.0%} (tactile.loss_max_share): check its cable"
            )

    def stop(self) -> None:
        """Close the lines."""
        self._running, self._fault = False, None
        self.close()
