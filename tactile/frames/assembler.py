"""The assembler of frames from bursts of messages; incomplete frames are dropped."""

import numpy as np
from numpy.typing import NDArray

from tactile.frames.codec import (
    CRC_BYTES,
    INDEX_BITS,
    MESSAGE_BYTES,
    PHASE_SHIFT,
    PHASES,
    TRAILER,
    FrameFormat,
    crc16_ccitt,
)
from tactile.source import COUNTER_MASK, FrameStatistics, TactileFrame

_HALF_TURN = 0x8000
"""Least difference to the last counter of a counter that is older, not newer."""


class _Burst:
    """The messages of one frame so far, by index."""

    def __init__(self, phase: int, n_messages: int, begun_s: float) -> None:
        self.phase = phase
        self.begun_s = begun_s
        self.parts: list[bytes | None] = [None] * n_messages
        self.missing = n_messages
        self.next_index = 0


class FrameAssembler:
    """Collects messages by index, in any order, and returns only complete frames.

    Two bursts are open at a time: the newest and the previous one. Each has only messages of its
    own phase, so a late message completes its own frame and never another one. A frame is returned
    if all its messages are present, the CRC over all data is right, and its counter fits its phase
    and is newer than that of the last frame.

    Parameters
    ----------
    order : (n_taxels,) int64
        Place in a burst of each taxel of a frame; None for the same order.
    """

    def __init__(self, frame_format: FrameFormat, order: NDArray[np.int64] | None = None) -> None:
        self._format, self._order = frame_format, order
        self._n = frame_format.n_messages
        self._long_header = frame_format.header_bytes == 2
        self._dtype = "<u1" if frame_format.sample_bytes == 1 else "<u2"
        self._open: dict[int, _Burst] = {}
        self._newest: _Burst | None = None
        self._last_counter: int | None = None
        self.counts = FrameStatistics()
        """Counts so far; they are updated."""

    def push(self, data: bytes | bytearray, t_s: float) -> TactileFrame | None:
        """Add one message and return the frame that it completes, if any."""
        if len(data) != MESSAGE_BYTES:
            self.counts.short += 1
            return None
        head = data[0]
        index = head & INDEX_BITS
        if self._long_header:
            index = index << 8 | data[1]
        if index >= self._n:
            self.counts.corrupt += 1
            return None
        phase = head >> PHASE_SHIFT
        burst = self._open.get(phase)
        part = None if burst is None else burst.parts[index]
        if part == data:
            self.counts.duplicate += 1
            return None
        if burst is None or part is not None:
            # Same phase, other content: four scans later. The two must not share messages.
            left_open = None if burst is self._newest else self._newest
            self._give_up_all_but(left_open)
            burst = self._newest = self._open[phase] = _Burst(phase, self._n, t_s)
        burst.parts[index] = bytes(data)
        self.counts.reordered += index < burst.next_index or burst is not self._newest
        burst.next_index = max(burst.next_index, index + 1)
        burst.missing -= 1
        return None if burst.missing else self._finish(burst, t_s)

    def _give_up_all_but(self, left_open: _Burst | None) -> None:
        """Close all bursts except one; those with missing messages are torn."""
        torn = (burst for burst in self._open.values() if burst is not left_open and burst.missing)
        self.counts.torn += sum(1 for _ in torn)
        self._open = {} if left_open is None else {left_open.phase: left_open}

    def _finish(self, burst: _Burst, t_s: float) -> TactileFrame | None:
        header = self._format.header_bytes
        whole = np.frombuffer(b"".join(filter(None, burst.parts)), dtype=np.uint8)
        payload = whole.reshape(self._n, MESSAGE_BYTES)[:, header:].tobytes()
        if burst is self._newest:
            # The previous burst is over. Another message of its phase is a late duplicate. After
            # two lost frames it is a new frame, which must not be compared with it.
            self._give_up_all_but(burst)
        counter, status, crc = TRAILER.unpack(payload[-TRAILER.size :])
        if crc16_ccitt(payload[:-CRC_BYTES]) != crc or counter % PHASES != burst.phase:
            self.counts.corrupt += 1
            return None
        if self._last_counter is not None:
            step = (counter - self._last_counter) & COUNTER_MASK
            if step == 0 or step >= _HALF_TURN:
                self.counts.stale += 1
                return None
            self.counts.lost += step - 1
        self._last_counter = counter
        self.counts.complete += 1
        counts = np.frombuffer(payload, dtype=self._dtype, count=self._format.n_taxels)
        counts = counts.astype(np.uint16)
        if self._order is not None:
            counts = counts[self._order]
        counts.setflags(write=False)
        return TactileFrame(
            t_s=t_s, counter=counter, status=status, counts=counts, begun_s=burst.begun_s
        )
