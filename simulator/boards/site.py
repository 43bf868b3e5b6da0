"""Where simulated sensor boards are: the world that they feel, faults and lines."""

from dataclasses import dataclass, field
from typing import Protocol

from simulator.can.faults import ControlUnitFaults
from simulator.can.link import CanDevice
from simulator.clock import ROUNDING_S
from simulator.world.world import PhysicalWorld
from tactile.layout import TaxelLayout

_KEPT_BYTES = 65536
"""Bytes that wait for a host; older ones are lost."""


@dataclass(slots=True, kw_only=True)
class BoardFaults:
    """Fault knobs of the boards, by finger where they meet one board."""

    unplugged: set[int] = field(default_factory=set)
    """Boards whose cable is out."""
    silent: set[int] = field(default_factory=set)
    """Boards that send nothing."""
    frozen: set[int] = field(default_factory=set)
    """Boards that send their last frame again and again."""
    repeated: float = 0.0
    lost_byte: float = 0.0
    torn: float = 0.0
    """Share of the frames that repeat the one before, lack one byte, or end in the middle."""
    late_s: float = 0.0
    """Time in s by which the bytes of frames come late."""
    rows: int = 0
    """Rows of the matrix that the firmware sends, 0 for the right ones: another profile."""
    marked: set[int] = field(default_factory=set)
    """Boards whose samples hold AA 55 at one place for ever, as a static load may make it."""


@dataclass(slots=True, kw_only=True)
class UskinFaults:
    """Fault knobs of the boards, by finger where they meet one board."""

    silent: set[int] = field(default_factory=set)
    """Boards whose plug is out."""
    low_supply: set[int] = field(default_factory=set)
    """Boards that restart again and again, and wait for their start."""
    doubled: set[int] = field(default_factory=set)
    """Boards beside which another one has the same address."""
    drift_counts_s: float = 0.0
    """Further drift of all taxels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BoardSite:
    """What simulated boards are made of."""

    world: PhysicalWorld
    """Presses objects onto the pads."""
    layout: TaxelLayout
    """The taxels."""
    taxel_faults: ControlUnitFaults
    """Faults of taxels and converters: `ControlUnitFaults.apply`."""
    faults: BoardFaults
    """Fault knobs of boards on serial lines."""
    uskin: UskinFaults
    """Fault knobs of boards on CAN."""
    seed: int
    """Seed of everything that comes by chance."""
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
        Of the line in bit/s, 8N1.
    """

    def __init__(self, line: int, site: BoardSite, *, baud_rate: int) -> None:
        self.line, self.site = line, site
        self.baudrate = 0
        """Line rate that the host has set; a USB device does not care."""
        self._byte_s = 10.0 / baud_rate
        self._sent: list[tuple[float, bytes]] = []

    @property
    def faults(self) -> "SerialBoard":
        """Faults of the line; see `unplugged`."""
        return self

    @property
    def unplugged(self) -> bool:
        """Whether its cable is out."""
        return self.line in self.site.faults.unplugged

    def receive(self, data: bytes, now_s: float, *, sent_after_s: float | None = None) -> None:
        """Take bytes of the host; ignored where there are no commands."""

    def advance_to(self, now_s: float) -> None:
        """Do what is due until ``now_s`` s."""

    def send(self, data: bytes, at_s: float) -> None:
        """Begin to send bytes at ``at_s`` s; of those that nobody takes the oldest are lost."""
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
        """Forget bytes under way."""
        self._sent.clear()


class SimulatedBoards(Protocol):
    """Settings of the simulated devices of a sensor that is no control unit."""

    def serial_boards(self, site: BoardSite) -> tuple[SerialBoard, ...]:
        """Return its devices on serial lines, in the order of the lines."""
        ...

    def can_device(self, site: BoardSite) -> CanDevice | None:
        """Return its device on CAN."""
        ...
