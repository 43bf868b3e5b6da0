"""Fault knobs of the CAN link and of the control unit; all of them are off by default."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from simulator.knobs import SHARE, Number, knob
from tactile.source import ForceMessage

_EMPTY_MESSAGES = 50
"""Number of stored messages of the empty pads, for their repetition."""
_SWAP_S = 1.5e-4
"""Delay in s of a swapped message: longer than its successor takes at 1 Mbit/s (135 us)."""


@dataclass(slots=True, kw_only=True)
class CanLinkFaults:
    """Knobs of the link between the control unit and the host."""

    drop_rate: float = knob("can.loss", "messages to the host are lost", SHARE)
    duplicate_rate: float = knob("can.duplicate", "messages come twice", SHARE)
    swap_rate: float = knob("can.swapped", "messages come after their successor", SHARE)
    corrupt_rate: float = knob("can.garbage", "one bit flips after the CRC check", SHARE)
    truncate_rate: float = knob("can.short", "fewer bytes than the length code", SHARE)
    """As by an adapter on a serial line."""
    wrong_dlc_rate: float = knob("can.wrong_dlc", "messages of another length", SHARE)
    """Their length code matches."""
    drop_next: int = 0
    """Number of next messages to the host that are lost."""
    delay_s: float = knob(
        "can.delayed", "messages to the host come late", Number("s", 0.0, 60.0, default=0.1)
    )
    flood_hz: float = knob(
        "can.flood",
        "messages of an unknown identifier with random content come at this rate",
        Number("Hz", 0.1, 20_000.0, default=8000.0),
    )
    error_passive: bool = knob("can.passive", "the host's controller is error-passive")
    bus_off: bool = knob("can.off", "the host's controller is bus-off: nothing passes")
    """The host's controller reports each begin of these states, and the end of error-passive, by an
    error frame."""
    unplugged: bool = knob("can.unplugged", "the host's adapter is unplugged")
    """Sending and receiving fail."""

    def pass_on(
        self, t_s: float, data: bytes, rng: np.random.Generator
    ) -> Iterator[tuple[float, int, bytes]]:
        """Yield the results of one message: any number of (arrival in s, length code, data)."""
        if self.bus_off:
            return
        if self.drop_next:
            self.drop_next -= 1
            return
        chance = rng.random(5).tolist()
        if chance[0] < self.drop_rate:
            return
        t_s += self.delay_s
        if chance[1] < self.swap_rate:
            t_s += _SWAP_S
        if data and chance[2] < self.corrupt_rate:
            bit = int(rng.integers(8 * len(data)))
            turned = bytearray(data)
            turned[bit // 8] ^= 1 << bit % 8
            data = bytes(turned)
        if data and self.wrong_dlc_rate and rng.random() < self.wrong_dlc_rate:
            data = data[: int(rng.integers(len(data)))]
        code = len(data)
        if data and chance[3] < self.truncate_rate:
            data = data[: int(rng.integers(len(data)))]
        yield t_s, code, data
        if chance[4] < self.duplicate_rate:
            yield t_s, code, data

    @property
    def disturbs(self) -> bool:
        """Whether messages to the host must be handled one by one."""
        return any(_DISTURBING(self))


_RATES = tuple(knob.name for knob in fields(CanLinkFaults) if knob.name.endswith("_rate"))
_DISTURBING = attrgetter("drop_next", "delay_s", "bus_off", *_RATES)
"""Knobs that change messages one by one; those of ``_RATES`` are probabilities."""


@dataclass(slots=True, kw_only=True)
class ControlUnitFaults:
    """Knobs inside the control unit."""

    dead: bool = knob("unit.off", "the control unit receives and sends nothing")
    """Afterwards it continues where it stopped."""
    heartbeat_off: bool = knob("unit.heartbeat_off", "the heartbeat stops, all else goes on")
    frozen: bool = knob("unit.stuck", "valid frames, always with the counts of the last scan")
    stuck_counts: dict[int, int] = field(default_factory=dict)
    """Taxels that always read the counts given."""
    offset_counts: float = knob(
        "taxels.offset",
        "counts added to each taxel",
        Number("counts", -65_535.0, 65_535.0, default=20.0),
    )
    gain: float = knob(
        "taxels.gain",
        "factor on the counts of each taxel",
        Number("factor", 0.0, 100.0, default=0.5),
        off=1.0,
    )
    """Applied before the offset."""
    mounted: NDArray[np.int64] | None = None
    """(n_taxels,) int64: taxel whose sample is sent at each place, for pads mounted differently
    from the layout."""
    pads_swapped: bool = knob(
        "unit.pads_swapped", "the pads of the two fingers are exchanged at the unit"
    )
    """So are the halves of a scan."""
    forces_off: bool = knob("unit.forces_off", "no force messages any more; frames go on")
    forces_lost: float = knob("unit.forces_lost", "force messages are lost, evenly", SHARE)
    forces_late_s: float = knob(
        "unit.forces_late", "force messages come late", Number("s", 0.0, 1.0, default=0.02)
    )
    forces_each: int = knob(
        "unit.forces_each",
        "the unit sends only every n-th force message; the counter shows no gap",
        Number("messages", 1, 100, default=15, whole=True),
        off=1,
    )
    force_gain: float = knob(
        "unit.force_gain",
        "factor on the force in force messages, as by a table of other pads",
        Number("factor", -100.0, 100.0, default=1.6),
        off=1.0,
    )
    force_offset_n: float = knob(
        "unit.force_offset", "offset of the force messages", Number("N", -60.0, 60.0, default=-2.0)
    )
    pads_empty: bool = knob("unit.pads_empty", "force messages repeat those of empty pads")
    """Their counters are new."""
    centres_stuck: bool = knob(
        "unit.centres_stuck", "the centre of force in the messages does not move"
    )
    centres_off: bool = knob("unit.centres_off", "force messages without a centre of force")
    centre_shift_taxels: float = knob(
        "unit.centre_shift",
        "the centre of force in the messages is shifted along the fingers",
        Number("pitches", -8.0, 8.0, default=1.0),
    )
    _empty_pads: deque[ForceMessage] = field(default_factory=lambda: deque(maxlen=_EMPTY_MESSAGES))
    _centre_taxels: tuple[float, float] | None = None

    def apply(self, counts: NDArray[np.uint16], adc_max: int) -> NDArray[np.uint16]:
        """Return counts (n_taxels,) with these faults; IndexError for an invalid taxel index."""
        if self.mounted is not None:
            counts = counts[self.mounted]
        if self.pads_swapped:
            counts = np.roll(counts, counts.size // 2)
        if self.offset_counts or self.gain != 1.0:
            shifted = np.rint(self.gain * counts + self.offset_counts)
            counts = np.clip(shifted, 0, adc_max).astype(np.uint16)
        for taxel, stuck in self.stuck_counts.items():
            counts[taxel] = stuck
        return counts

    def spoil(self, message: ForceMessage) -> ForceMessage:
        """Return a force message with the faults of forces and centres."""
        if message.centre_taxels is None and not self.pads_empty:
            self._empty_pads.append(message)
        if self.pads_empty and self._empty_pads:
            self._empty_pads.rotate(-1)
            empty = self._empty_pads[0]
            return replace(message, force_n=empty.force_n, centre_taxels=empty.centre_taxels)
        first_n, second_n = (self.force_gain * n + self.force_offset_n for n in message.force_n)
        force_n, centre = (first_n, second_n), message.centre_taxels
        if self.centres_stuck:
            centre = self._centre_taxels
        self._centre_taxels = centre
        if centre is not None:
            centre = None if self.centres_off else (centre[0] + self.centre_shift_taxels, centre[1])
        return replace(message, force_n=force_n, centre_taxels=centre)
