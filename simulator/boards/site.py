"""Environment of simulated sensor boards: world, faults and lines."""

import math
from dataclasses import dataclass
from typing import Protocol

from simulator.can.faults import ControlUnitFaults
from simulator.can.link import CanDevice
from simulator.clock import ROUNDING_S
from simulator.knobs import FINGER, SHARE, Number, knob
from simulator.world.world import PhysicalWorld
from tactile.layout import TaxelLayout

_MOST_BYTES = 65536
"""Most bytes that wait for a host; older bytes are lost."""


@dataclass(slots=True, kw_only=True)
class BoardFaults:
    """Knobs of the boards on serial lines (``board``) and on CAN (``uskin``)."""

    unplugged: frozenset[int] = knob("board.unplugged", "this finger's board is unplugged", FINGER)
    silent: frozenset[int] = knob("board.off", "the board of this finger sends nothing", FINGER)
    frozen: frozenset[int] = knob(
        "board.frozen", "the board of this finger always sends one frame", FINGER
    )
    marked: frozenset[int] = knob(
        "board.marked",
        "the samples of this finger's board always contain a header at one place",
        FINGER,
    )
    repeated: float = knob("board.repeated", "frames of both boards repeat the one before", SHARE)
    lost_byte: float = knob("board.lost_byte", "frames of both boards lack one byte", SHARE)
    torn: float = knob("board.torn", "frames of both boards end in the middle", SHARE)
    late_s: float = knob(
        "board.late", "frames of both boards come late", Number("s", 0.0, 1.0, default=0.05)
    )
    rows: int = knob(
        "board.rows",
        "both boards send this number of rows: another profile",
        Number("rows", 1, 64, default=16, whole=True),
    )
    off: frozenset[int] = knob("uskin.off", "this finger's board is unplugged", FINGER)
    low_supply: frozenset[int] = knob(
        "uskin.low_supply",
        "this finger's board restarts at low supply and waits for its start",
        FINGER,
    )
    doubled: frozenset[int] = knob(
        "uskin.doubled", "another board has the address of this finger's board", FINGER
    )
    drift_counts_s: float = knob(
        "uskin.drift", "z of all taxels drifts", Number("counts/s", -1e5, 1e5, default=1000.0)
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSite:
    """Values for the creation of simulated boards."""

    world: PhysicalWorld
    """Presses objects onto the pads."""
    layout: TaxelLayout
    """The taxels."""
    taxel_faults: ControlUnitFaults
    """Faults of taxels and converters: `ControlUnitFaults.apply`."""
    faults: BoardFaults
    """Fault knobs of the boards."""
    seed: int
    """Seed of all random values."""
    start_s: float
    """Time in s at which they are switched on."""


class SerialBoard:
    """A board on a serial line; implements `simulator.servo.bus.SerialDevice`.

    A subclass sends in `advance_to` or `receive`.

    Parameters
    ----------
    line
        Number of its line, as in `BoardFaults.unplugged`.
    baud_rate
        Bit rate of the line in bit/s, 8N1.
    """

    def __init__(self, line: int, site: BoardSite, *, baud_rate: int) -> None:
        self.line, self.site = line, site
        self.baudrate = 0
        """Line rate set by the host; a USB device ignores it."""
        self._byte_s = 10.0 / baud_rate
        self._sent: list[tuple[float, bytes]] = []

    @property
    def unplugged(self) -> bool:
        """Whether its cable is unplugged."""
        return self.line in self.site.faults.unplugged

    def receive(self, data: bytes, now_s: float, *, sent_after_s: float | None = None) -> None:
        """Take bytes of the host; a board without commands ignores them."""

    def advance_to(self, now_s: float) -> None:
        """Advance the board to ``now_s`` s."""

    def send(self, data: bytes, at_s: float) -> None:
        """Begin to send bytes at ``at_s`` s; without a reader the oldest bytes are lost."""
        self._sent.append((at_s, data))
        del self._sent[: -max(1, _MOST_BYTES // max(1, len(data)))]

    def transmit(self, now_s: float) -> bytes:
        """Return the bytes that have reached the host by ``now_s``."""
        data = bytearray()
        while self._sent:
            begin_s, frame = self._sent[0]
            n = int((now_s + ROUNDING_S - begin_s) / self._byte_s)
            if n <= 0:
                break
            data += frame[:n]
            if n < len(frame):
                self._sent[0] = (begin_s + n * self._byte_s, frame[n:])
                break
            del self._sent[0]
        return b"" if self.unplugged else bytes(data[-_MOST_BYTES:])

    def next_event_s(self) -> float:
        """Return when the next bytes reach the host; infinity: none are under way."""
        return self._sent[0][0] + self._byte_s if self._sent else math.inf

    def drop_pending(self) -> None:
        """Drop bytes in transit."""
        self._sent.clear()


class SimulatedBoards(Protocol):
    """Settings of the simulated devices of a sensor without control unit."""

    def serial_boards(self, _site: BoardSite) -> tuple[SerialBoard, ...]:
        """Return its devices on serial lines, in the order of the lines."""
        return ()

    def can_device(self, _site: BoardSite) -> CanDevice | None:
        """Return its device on CAN."""
        return None
