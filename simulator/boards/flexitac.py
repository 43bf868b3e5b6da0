"""A FlexiTac board on its serial line: continuous frames, with faults of line and firmware."""

from dataclasses import dataclass, field

import numpy as np

from simulator.boards.resistive import Counts, ResistivePads
from simulator.clock import ROUNDING_S

_BYTE_S = 10.0 / 2_000_000
"""Time in s of a byte on the line: 2 Mbit/s, 8N1."""
_RATE_HZ = (90.0, 110.0)
"""Range of the rates of boards in Hz."""
_JITTER = 0.03
"""Standard deviation of a period over its mean. [assumed]"""
_KEPT_BYTES = 65536
"""Most bytes that wait for a host; older bytes are lost."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlexiTacSettings:
    """Two equal boards."""

    rows: int = 12
    columns: int = 32
    """Size of the matrix that a board sends."""
    rows_along: bool = False
    """Whether the rows of a board follow each other along the finger; else across it."""


@dataclass(slots=True, kw_only=True)
class BoardFaults:
    """Fault knobs of the boards; knobs of one board have the finger as value."""

    unplugged: set[int] = field(default_factory=set)
    """Boards whose cable is unplugged."""
    silent: set[int] = field(default_factory=set)
    """Boards that send nothing."""
    frozen: set[int] = field(default_factory=set)
    """Boards that repeat their last frame."""
    repeated: float = 0.0
    lost_byte: float = 0.0
    torn: float = 0.0
    """Share of the frames that repeat the one before, lack one byte, or end in the middle."""
    late_s: float = 0.0
    """Delay of the bytes of frames in s."""
    rows: int = 0
    """Number of rows in a frame of another profile; 0: the correct number."""
    marked: set[int] = field(default_factory=set)
    """Boards whose samples always contain AA 55 at one place, as by a static load."""


class FlexiTacBoard:
    """One board on a serial port; implements `simulator.servo.bus.SerialDevice`."""

    def __init__(
        self,
        finger: int,
        pads: ResistivePads,
        taxels: slice,
        settings: FlexiTacSettings,
        faults: BoardFaults,
        *,
        seed: int,
        start_s: float,
    ) -> None:
        self._finger, self._pads, self._taxels = finger, pads, taxels
        self._settings, self.knobs = settings, faults
        self._rng = np.random.default_rng([seed, 3 + finger])
        self._period_s = 1.0 / self._rng.uniform(*_RATE_HZ)
        self._due_s = start_s + self._rng.uniform(0.0, self._period_s)
        self._sent: list[tuple[float, bytes]] = []
        self._last = b""
        self.baudrate = 0
        """Line rate set by the host; a USB device ignores it."""

    @property
    def faults(self) -> "FlexiTacBoard":
        """Faults of the line; see `unplugged`."""
        return self

    @property
    def unplugged(self) -> bool:
        """Whether its cable is out."""
        return self._finger in self.knobs.unplugged

    def receive(self, data: bytes, now_s: float, *, sent_after_s: float | None = None) -> None:
        """Ignore the host's bytes: there are no commands."""

    def advance_to(self, now_s: float) -> None:
        """Scan and send the due frames."""
        if self._due_s < now_s - 10.0 * self._period_s:
            self._due_s = now_s
        while self._due_s <= now_s + ROUNDING_S:
            self._send(self._due_s)
            self._due_s += self._period_s * max(0.5, 1.0 + _JITTER * self._rng.standard_normal())

    def transmit(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by ``now_s``."""
        data = bytearray()
        while self._sent:
            begin_s, frame = self._sent[0]
            n = int((now_s + ROUNDING_S - begin_s) / _BYTE_S)
            if n <= 0:
                break
            data += frame[:n]
            if n < len(frame):
                self._sent[0] = (begin_s + n * _BYTE_S, frame[n:])
                break
            del self._sent[0]
        return b"" if self.unplugged else bytes(data[-_KEPT_BYTES:])

    def next_event_s(self) -> float | None:
        """Return when the next bytes reach the host."""
        return self._sent[0][0] + _BYTE_S if self._sent else None

    def drop_pending(self) -> None:
        """Forget bytes under way."""
        self._sent.clear()

    def _send(self, now_s: float) -> None:
        knobs, chance = self.knobs, self._rng.random(3)
        if self._finger in knobs.silent:
            return
        again = self._finger in knobs.frozen or chance[0] < knobs.repeated
        if not (again and self._last):
            self._last = self._frame(self._pads.scan()[self._taxels])
        frame = self._last
        if chance[1] < knobs.lost_byte:
            place = int(self._rng.integers(2, len(frame)))
            frame = frame[:place] + frame[place + 1 :]
        if chance[2] < knobs.torn:
            frame = frame[: len(frame) // 2]
        self._sent.append((now_s + knobs.late_s, frame))
        del self._sent[: -_KEPT_BYTES // len(self._last)]

    def _frame(self, counts: Counts) -> bytes:
        size = self._settings
        shape = (size.rows, size.columns) if size.rows_along else (size.columns, size.rows)
        matrix = counts.reshape(shape)
        matrix = matrix if size.rows_along else matrix.T
        if self.knobs.rows:
            matrix = np.resize(matrix, (self.knobs.rows, size.columns))
        data = bytearray(matrix.astype(np.uint8).tobytes())
        if self._finger in self.knobs.marked:
            data[100:102] = b"\xaa\x55"
        return b"\xaa\x55" + bytes(data)
