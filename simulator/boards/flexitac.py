"""A FlexiTac board on its serial line: continuous frames, with faults of line and firmware."""

from dataclasses import dataclass

import numpy as np

from simulator.boards.resistive import Counts, ResistivePads
from simulator.boards.site import BoardSite, SerialBoard, SimulatedBoards
from simulator.clock import ROUNDING_S

_BAUD_RATE = 2_000_000
"""Line rate in bit/s."""
_RATE_HZ = (90.0, 110.0)
"""Range of the rates of boards in Hz."""
_JITTER = 0.03
"""Standard deviation of a period over its mean. [assumed]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlexiTacSettings(SimulatedBoards):
    """Two equal boards."""

    rows: int = 12
    columns: int = 32
    """Size of the matrix that a board sends."""
    rows_along: bool = False
    """Whether the rows of a board follow each other along the finger; else across it."""

    def serial_boards(self, site: BoardSite) -> tuple[SerialBoard, ...]:
        """Return both boards."""
        pads = ResistivePads(site.world, site.layout, site.taxel_faults, seed=site.seed)
        return tuple(FlexiTacBoard(finger, pads, self, site) for finger in (0, 1))


class FlexiTacBoard(SerialBoard):
    """One board: continuous frames."""

    def __init__(
        self, finger: int, pads: ResistivePads, settings: FlexiTacSettings, site: BoardSite
    ) -> None:
        super().__init__(finger, site, baud_rate=_BAUD_RATE)
        self._pads, self._settings, self.knobs = pads, settings, site.faults
        self._taxels = site.layout.taxels_of(site.layout.gripping_pads[finger])
        self._rng = np.random.default_rng([site.seed, 3 + finger])
        self._period_s = 1.0 / self._rng.uniform(*_RATE_HZ)
        self._due_s = site.start_s + self._rng.uniform(0.0, self._period_s)
        self._last = b""

    def advance_to(self, now_s: float) -> None:
        """Scan and send the due frames."""
        if self._due_s < now_s - 10.0 * self._period_s:
            self._due_s = now_s
        while self._due_s <= now_s + ROUNDING_S:
            self._send(self._due_s)
            self._due_s += self._period_s * max(0.5, 1.0 + _JITTER * self._rng.standard_normal())

    def _send(self, now_s: float) -> None:
        knobs, chance = self.knobs, self._rng.random(3)
        if self.line in knobs.silent:
            return
        again = self.line in knobs.frozen or chance[0] < knobs.repeated
        if not (again and self._last):
            self._last = self._frame(self._pads.scan()[self._taxels])
        frame = self._last
        if chance[1] < knobs.lost_byte:
            place = int(self._rng.integers(2, len(frame)))
            frame = frame[:place] + frame[place + 1 :]
        if chance[2] < knobs.torn:
            frame = frame[: len(frame) // 2]
        self.send(frame, now_s + knobs.late_s)

    def _frame(self, counts: Counts) -> bytes:
        size = self._settings
        shape = (size.rows, size.columns) if size.rows_along else (size.columns, size.rows)
        matrix = counts.reshape(shape)
        matrix = matrix if size.rows_along else matrix.T
        if self.knobs.rows:
            matrix = np.resize(matrix, (self.knobs.rows, size.columns))
        data = bytearray(matrix.astype(np.uint8).tobytes())
        if self.line in self.knobs.marked:
            data[100:102] = b"\xaa\x55"
        return b"\xaa\x55" + bytes(data)
