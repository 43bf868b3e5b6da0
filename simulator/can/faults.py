"""Fault knobs of the CAN link and of the control unit; all of them are off by default."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from tactile.source import ForceMessage

_EMPTY_MESSAGES = 50
"""Number of stored messages of the empty pads, for their repetition."""
_SWAP_S = 1.5e-4
"""Delay in s of a swapped message: longer than its successor takes at 1 Mbit/s (135 us)."""


@dataclass(slots=True, kw_only=True)
class CanLinkFaults:
    """Knobs of the link between the control unit and the host."""

    drop_rate: float = 0.0
    duplicate_rate: float = 0.0
    swap_rate: float = 0.0
    corrupt_rate: float = 0.0
    truncate_rate: float = 0.0
    """Probability from 0 to 1 that a message to the host is lost, comes twice, comes after its
    successor, has one bit flipped after the CRC check, or has fewer bytes than its length code
    (as by an adapter on a serial line)."""
    wrong_dlc_rate: float = 0.0
    """Probability that a message has fewer bytes, with a matching length code."""
    drop_next: int = 0
    """Number of next messages to the host that are lost."""
    delay_s: float = 0.0
    """Delay of messages to the host in s."""
    flood_hz: float = 0.0
    """Rate in Hz of messages with an unknown identifier and random content."""
    error_passive: bool = False
    bus_off: bool = False
    """States of the host's CAN controller. It reports each begin of a state, and the end of
    error-passive, by an error frame; while it is bus-off no message passes."""
    unplugged: bool = False
    """The host's adapter is gone: sending and receiving fail."""

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

    dead: bool = False
    """The unit receives and sends nothing; afterwards it continues where it stopped."""
    heartbeat_off: bool = False
    """The heartbeat stops, all else goes on."""
    frozen: bool = False
    """The converter always returns its last scan; counter and checksum are valid."""
    stuck_counts: dict[int, int] = field(default_factory=dict)
    """Taxels that always read the counts given."""
    offset_counts: float = 0.0
    """Drift that is added to all taxels."""
    gain: float = 1.0
    """Factor on all taxels before the offset."""
    mounted: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    """Orders of the taxels (n_taxels,) by name, for pads mounted differently from the layout. Each
    element is the taxel whose sample is sent at that place."""
    pads_swapped: bool = False
    """The connectors of the two fingers are exchanged: so are the halves of a scan."""
    forces_off: bool = False
    """No force messages any more; frames go on."""
    forces_lost: float = 0.0
    """Share from 0 to 1 of the force messages, evenly spaced, that are lost."""
    forces_late_s: float = 0.0
    """Delay in s of force messages after their scan."""
    forces_each: float = 1.0
    """Only each n-th force message is made; the counter counts only these."""
    force_gain: float = 1.0
    force_offset_n: float = 0.0
    """Factor on the forces in the messages, as by a table of other pads; offset in N."""
    pads_empty: bool = False
    """The force messages are those of the empty pads, with new counters."""
    centres_stuck: bool = False
    centres_off: bool = False
    """The centre in the messages does not move; messages have no centre."""
    centre_shift_taxels: float = 0.0
    """Shift of the centre in the messages along the fingers in taxel pitches."""
    _empty_pads: deque[ForceMessage] = field(default_factory=lambda: deque(maxlen=_EMPTY_MESSAGES))
    _centre_taxels: tuple[float, float] | None = None

    def apply(self, counts: NDArray[np.uint16], adc_max: int) -> NDArray[np.uint16]:
        """Return counts (n_taxels,) with these faults; IndexError for an invalid taxel index."""
        for order in self.mounted.values():
            counts = counts[order]
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
        if (force_n, centre) == (message.force_n, message.centre_taxels):
            return message
        return replace(message, force_n=force_n, centre_taxels=centre)


@dataclass(slots=True)
class Disturber:
    """Applies the faults of a link to single messages, given as (time in s, identifier, data)."""

    faults: CanLinkFaults
    """The knobs."""
    rng: np.random.Generator

    def pass_on(self, t_s: float, data: bytes) -> Iterable[tuple[float, int, bytes]]:
        """Return the results of one message: any number of (arrival in s, length code, data)."""
        faults = self.faults
        if faults.bus_off:
            return
        if faults.drop_next:
            faults.drop_next -= 1
            return
        chance = self.rng.random(5).tolist()
        if chance[0] < faults.drop_rate:
            return
        t_s += faults.delay_s
        if chance[1] < faults.swap_rate:
            t_s += _SWAP_S
        if data and chance[2] < faults.corrupt_rate:
            bit = int(self.rng.integers(8 * len(data)))
            turned = bytearray(data)
            turned[bit // 8] ^= 1 << bit % 8
            data = bytes(turned)
        if data and faults.wrong_dlc_rate and self.rng.random() < faults.wrong_dlc_rate:
            data = data[: int(self.rng.integers(len(data)))]
        code = len(data)
        if data and chance[3] < faults.truncate_rate:
            data = data[: int(self.rng.integers(len(data)))]
        yield t_s, code, data
        if chance[4] < faults.duplicate_rate:
            yield t_s, code, data
