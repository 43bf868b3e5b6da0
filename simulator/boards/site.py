"""Environment of simulated sensor boards: world, faults and lines."""

from dataclasses import dataclass, field
from typing import Protocol

from simulator.can.faults import ControlUnitFaults
from simulator.can.link import CanDevice
from simulator.clock import ROUNDING_S
from simulator.world.world import PhysicalWorld
from tactile.layout import TaxelLayout

_KEPT_BYTES = 65536
"""Most bytes that wait for a host; older bytes are lost."""


@dataclass(slots=True, kw_only=True)
class BoardFaults:
    """Fault knobs of the boards, by finger where they meet one board."""

    unplugged: set[int] = field(default_factory=set)
    """Boards whose cable is unplugged."""
    silent: set[int] = field(default_factory=set)
    """Boards that send nothing, on CAN unplugged ones."""
    frozen: set[int] = field(default_factory=set)
    """Boards that repeat their last frame."""
    repeated: float = 0.0
    lost_byte: float = 0.0
    torn: float = 0.0
    """Share of the frames that repeat the previous one, lack one byte, or end in the middle."""
    late_s: float = 0.0
    """Delay of the bytes of frames in s."""
    rows: int = 0
    """Number of rows in a frame of another profile; 0: the correct number."""
    marked: set[int] = field(default_factory=set)
    """Boards whose samples always contain AA 55 at one place, as by a static load."""
    low_supply: set[int] = field(default_factory=set)
    """Boards on CAN that restart repeatedly and wait for their start."""
    doubled: set[int] = field(default_factory=set)
    """Boards on CAN with the same address as another board."""
    drift_counts_s: float = 0.0
    """Further drift of all taxels of boards on CAN."""


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
        del self._sent[: -max(1, _KEPT_BYTES // max(1, len(data)))]

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
        return b"" if self.unplugged else bytes(data[-_KEPT_BYTES:])

    def next_event_s(self) -> float | None:
        """Return when the next bytes reach the host."""
        return self._sent[0][0] + self._byte_s if self._sent else None

    def drop_pending(self) -> None:
        """Drop bytes in transit."""
        self._sent.clear()


class SimulatedBoards(Protocol):
    """Settings of the simulated devices of a sensor without control unit."""

    def serial_boards(self, site: BoardSite) -> tuple[SerialBoard, ...]:
        """Return its devices on serial lines, in the order of the lines."""
        ...

    def can_device(self, site: BoardSite) -> CanDevice | None:
        """Return its device on CAN."""
        ...
