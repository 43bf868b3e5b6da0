"""Frame sources: the protocol of each tactile sensor, and its values.

The CANopen control unit (`tactile.control_unit`) is one source. Higher layers work with any source.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from enum import IntFlag
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from tactile.errors import LinkFault, LinkStateError
from tactile.layout import TaxelLayout

_Result = TypeVar("_Result")

COUNTER_MASK = 0xFFFF
"""The counter of a frame has 16 bits."""


class ScanStatus(IntFlag):
    """Status bits of a frame or a force message."""

    ZEROED = 0x1
    """Table and zero are set: the values of a force message are forces."""
    SATURATED = 0x2
    """A taxel is at full scale; in a force message one of a gripping pad: its force may be larger.
    """
    CONVERTER_FAULT = 0x4
    """The converter or multiplexer failed its self-test: samples and forces are void."""
    OVERRUN = 0x8
    """The previous frame was not sent in time, or the previous scan was left out."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TactileFrame:
    """One whole scan of all taxels."""

    t_s: float
    """Monotonic time in s of the reception of its last byte."""
    counter: int
    """Number of the scan, modulo 65536. A source without a counter numbers its frames itself."""
    status: int
    """`ScanStatus` bits; 0 from a source without a status."""
    counts: NDArray[np.uint16] = field(repr=False)
    """(n_taxels,) uint16: samples in the order of the layout."""
    extra: NDArray[np.uint16] | None = None
    """(n_taxels, k) uint16: further samples of each taxel, which are only recorded; None without
    any."""
    begun_s: float | None = None
    """Monotonic time in s of the reception of its first byte, just after the scan; None where
    unknown."""

    @property
    def scanned_s(self) -> float:
        """Monotonic time of the scan in s, as precisely as known."""
        return self.t_s if self.begun_s is None else self.begun_s


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceMessage:
    """Force on both gripping pads in one scan, summed by the source."""

    t_s: float
    """Monotonic time of reception in s."""
    counter: int
    """Number of the message modulo 16."""
    status: ScanStatus
    """Status bits."""
    force_n: tuple[float, float]
    """Force on the pad of finger 0 and of finger 1 in N."""
    centre_taxels: tuple[float, float] | None = None
    """Centre of force of both pads together, along and across the fingers from the pads' middle, in
    pitches of the taxels; None without contact."""


def mean_centre_taxels(messages: Sequence[ForceMessage]) -> tuple[float, float] | None:
    """Return the centre of several messages in pitches, weighted by their forces.

    At almost no force, for example during a release, a centre is only noise. Returns None without
    a message that has both a centre and a force.
    """
    loaded = [
        (max(0.0, sum(message.force_n)), message.centre_taxels)
        for message in messages
        if message.centre_taxels is not None
    ]
    total_n = sum(force_n for force_n, _ in loaded)
    if not total_n > 0.0:
        return None
    along = sum(force_n * centre[0] for force_n, centre in loaded) / total_n
    across = sum(force_n * centre[1] for force_n, centre in loaded) / total_n
    return along, across


@dataclass(frozen=True, slots=True)
class Arrivals:
    """What a source received since the last poll, oldest first."""

    frames: tuple[TactileFrame, ...] = ()
    forces: tuple[ForceMessage, ...] = ()
    """Force messages; none from a source that sends frames alone."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PadZero:
    """Zero of the gripping pads, the taxels of finger 0 first, for a source that sums forces."""

    offset_counts: NDArray[np.float64]
    """(n,) float64: counts of each taxel without load."""
    touch_counts: float
    """Threshold of a taxel's mean over 3 x 3 taxels and 4 scans: below it the source leaves the
    taxel out."""
    bad: NDArray[np.bool_]
    """(n,) bool: taxels that do not measure."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceIdentity:
    """Identity of the device that answers. A device without a number has 0 there."""

    name: str = ""
    vendor_id: int = 0
    product_code: int = 0
    revision: int = 0
    serial: int = 0
    boards: tuple[int, int] = (0, 0)
    """Serial numbers of the pads' boards on finger 0 and finger 1."""
    sends_forces: bool = False
    """Whether the device was set up to send force messages."""


@dataclass(slots=True, kw_only=True)
class FrameStatistics:
    """Counts of frames and of their messages. A source counts what it can detect."""

    complete: int = 0
    """Frames handed out."""
    lost: int = 0
    """Frames missing between two handed out, by their counters."""
    torn: int = 0
    """Frames begun and given up because messages were missing."""
    duplicate: int = 0
    """Messages received twice, dropped."""
    reordered: int = 0
    """Messages received just after one with a higher index, or in a newer frame; used."""
    stale: int = 0
    """Whole frames that were not newer than the last one handed out, dropped."""
    short: int = 0
    """Messages of a wrong length, dropped."""
    corrupt: int = 0
    """Frames or messages refused: wrong checksum, phase or index."""


@dataclass(slots=True, kw_only=True)
class ForceStatistics:
    """Counts of force messages since the start."""

    received: int = 0
    """Messages handed out."""
    lost: int = 0
    """Messages missing between two handed out, by counter; after a silence so many at least."""
    repeated: int = 0
    """Messages received twice, dropped."""
    late: int = 0
    """Messages received after a newer one, dropped."""
    damaged: int = 0
    """Messages with a wrong CRC or length, dropped."""


@dataclass(slots=True, kw_only=True)
class SourceStatistics:
    """Counts of a source since its start."""

    frames: FrameStatistics = field(default_factory=FrameStatistics)
    recent_loss_rate: float = 0.0
    """Share of the newest frames that were lost, 0 to 1."""
    forces: ForceStatistics = field(default_factory=ForceStatistics)
    malformed: int = 0
    """Other messages that cannot be used."""
    error_frames: int = 0
    """Errors that the controller of the line reported."""
    foreign: int = 0
    """Messages of other devices on the same line."""
    requests: int = 0
    """Requests for a frame, as SYNC; 0 where the device sends unasked."""
    late_requests: int = 0
    """Requests that were sent more than one period late; they are not made up for."""

    def copied(self, **changes: Any) -> "SourceStatistics":
        """Return the present counts with changes; the source goes on with its own."""
        return replace(self, frames=replace(self.frames), forces=replace(self.forces), **changes)


class LatchingSource:
    """Base of sources: they read only while they run, and latch a fault until a new start."""

    def __init__(self) -> None:
        self.fault: LinkFault | None = None
        """The latched fault, None without one."""
        self._running = False

    def _guarded(self, action: Callable[[], _Result]) -> _Result:
        """Return the result of an action that needs a running source without a fault."""
        if self.fault is not None:
            raise self.fault
        if not self._running:
            raise LinkStateError("the sensor is not running: start it first")
        try:
            return action()
        except LinkFault as fault:
            self.fault = fault
            raise


class FrameSource(Protocol):
    """A source of tactile frames: one sensor with all its pads. One thread uses it.

    A source raises `tactile.errors.LinkFault` for a fault of the device or its line. Every
    later call raises the same fault again, until `stop` and `start`.
    """

    @property
    def layout(self) -> TaxelLayout:
        """The taxels, in the order of the counts."""

    @property
    def statistics(self) -> SourceStatistics:
        """Counts since the last start."""

    def start(self) -> SourceIdentity:
        """Check the device, start its frames and return its identity; reopen a lost line."""
        ...

    def poll(self) -> Arrivals:
        """Return what arrived since the last call; does not wait. Checks all deadlines."""
        ...

    def set_zero(self, zero: PadZero) -> None:
        """Set the zero of the force messages. A source without force messages ignores it.

        Force messages that arrived before are dropped.
        """

    def stop(self) -> None:
        """Stop the frames. Does not raise on a dead line, and leaves the line open."""
