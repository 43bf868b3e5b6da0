"""Fault knobs of the CAN link and of the control unit; all of them are off by default."""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError
from tactile.source import ForceMessage

_EMPTY_MESSAGES = 50
"""Messages of the empty pads that are kept to be shown again."""
_SWAP_S = 1.5e-4
"""Delay in s of a swapped message: longer than the one after it takes at 1 Mbit/s (135 us)."""


@dataclass(slots=True, kw_only=True)
class CanLinkFaults:
    """Knobs of the way between the control unit and the host."""

    drop_rate: float = 0.0
    duplicate_rate: float = 0.0
    swap_rate: float = 0.0
    corrupt_rate: float = 0.0
    truncate_rate: float = 0.0
    """Probability from 0 to 1 that a message to the host is lost, comes twice, comes after its
    successor, has one bit turned after the CAN checksum, or has fewer bytes than its length code
    (as an adapter on a serial line makes them)."""
    wrong_dlc_rate: float = 0.0
    """Probability that a message comes with fewer bytes and a length code that fits them."""
    drop_next: int = 0
    """So many of the next messages to the host are lost."""
    delay_s: float = 0.0
    """Messages to the host come so much later, in s."""
    flood_hz: float = 0.0
    """Messages with an unknown identifier and random content that come every second."""
    error_passive: bool = False
    bus_off: bool = False
    """The host's CAN controller reports that state with an error frame, once each time it is
    switched on (and the way back from error-passive); while it is bus-off nothing passes in either
    direction."""
    unplugged: bool = False
    """The host's adapter is gone: sending and receiving fail."""
    bitrate: int = 0
    """Bit rate in bit/s of the bus in the place of the settings' one, 0 for that; a host that is
    set to another one hears and reaches nobody."""

    @property
    def disturbs(self) -> bool:
        """Whether messages to the host are to be looked at one by one."""
        return any(getattr(self, name) for name in ("drop_next", "delay_s", "bus_off", *_RATES))

    def check(self) -> None:
        """Refuse impossible values; the bus calls it when a fault is in use."""
        for name in _RATES:
            rate = getattr(self, name)
            if not 0.0 <= rate <= 1.0:
                raise SimulatorSettingsError(f"fault {name} is {rate}, must be from 0 to 1")
        for name in ("drop_next", "delay_s", "flood_hz"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise SimulatorSettingsError(f"fault {name} is {value}, must be at least 0")


_RATES = tuple(one.name for one in fields(CanLinkFaults) if one.name.endswith("_rate"))
"""Knobs that are probabilities."""


@dataclass(slots=True, kw_only=True)
class ControlUnitFaults:
    """Knobs inside the control unit."""

    dead: bool = False
    """The unit neither hears nor sends anything; it comes back where it stopped."""
    heartbeat_off: bool = False
    """The heartbeat stops, all else goes on."""
    frozen: bool = False
    """The converter returns its last scan for ever; counter and checksum are valid."""
    converter_fault: bool = False
    """The self-test of the converter fails: a bit in the status of the frames."""
    stuck_counts: dict[int, int] = field(default_factory=dict)
    """Taxels that always read the counts given."""
    dead_taxels: set[int] = field(default_factory=set)
    """Taxels that always read 0."""
    offset_counts: float = 0.0
    """Drift that is added to all taxels."""
    gain: float = 1.0
    """Factor on all taxels before the offset."""
    late_s: float = 0.0
    """The burst of a frame begins so long after its SYNC, in s."""
    mounted: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    """Orders of the taxels (n_taxels,) by name: how pads sit otherwise than the layout has them.
    The sample that is sent at a place is that of the taxel named there."""
    noisy_taxels: dict[int, float] = field(default_factory=dict)
    """Standard deviation in counts of further noise on taxels."""
    pads_swapped: bool = False
    """The connectors of the two fingers are exchanged: each half of a scan stands where the other
    belongs."""
    forces_off: bool = False
    """No force messages any more; frames go on."""
    forces_lost: float = 0.0
    forces_twice: float = 0.0
    forces_swapped: float = 0.0
    """Share from 0 to 1 of the force messages, evenly, that are lost, come twice, or come after the
    next one."""
    forces_again_s: float = 0.0
    """Each force message comes once more so long later, in s; 0: it does not."""
    forces_late_s: float = 0.0
    """Force messages come so long after their scan, in s."""
    forces_each: float = 1.0
    """Only each so many-th force message is made; the counter counts those that are."""
    force_gain: float = 1.0
    force_offset_n: float = 0.0
    """Factor on the forces in the messages, as of a table of other pads; N added to each."""
    spoiled_each: float = 1.0
    """These two spoil only each so many-th force message."""
    pads_empty: bool = False
    """The force messages are those of the empty pads, with new counters."""
    centres_stuck: bool = False
    centres_off: bool = False
    """The centre in the messages stays as it is; there is none."""
    centre_shift_taxels: float = 0.0
    """Pitches of the taxels by which the centre in the messages is shifted along the fingers."""
    _n_spoiled: int = 0
    _empty_pads: deque[ForceMessage] = field(default_factory=lambda: deque(maxlen=_EMPTY_MESSAGES))
    _centre_taxels: tuple[float, float] | None = None
    _rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def apply(self, counts: NDArray[np.uint16], adc_max: int) -> NDArray[np.uint16]:
        """Return converted counts (n_taxels,) with these faults; IndexError for no taxel."""
        for order in self.mounted.values():
            counts = counts[order]
        if self.pads_swapped:
            counts = np.roll(counts, counts.size // 2)
        if self.offset_counts or self.gain != 1.0:
            shifted = np.rint(self.gain * counts + self.offset_counts)
            counts = np.clip(shifted, 0, adc_max).astype(np.uint16)
        if self.noisy_taxels:
            taxels = list(self.noisy_taxels)
            noise = self._rng.normal(0.0, list(self.noisy_taxels.values()))
            shaken = np.clip(np.rint(counts[taxels] + noise), 0, adc_max)
            counts = counts.copy()
            counts[taxels] = shaken.astype(np.uint16)
        for taxel, stuck in self.stuck_counts.items():
            counts[taxel] = stuck
        if self.dead_taxels:
            counts[list(self.dead_taxels)] = 0
        return counts

    def spoil(self, message: ForceMessage) -> ForceMessage:
        """Return a force message with the faults of forces and centres."""
        if message.centre_taxels is None and not self.pads_empty:
            self._empty_pads.append(message)
        if self.pads_empty and self._empty_pads:
            self._empty_pads.rotate(-1)
            shown = self._empty_pads[0]
            return replace(message, force_n=shown.force_n, centre_taxels=shown.centre_taxels)
        force_n, centre = message.force_n, message.centre_taxels
        self._n_spoiled += 1
        if self._n_spoiled >= self.spoiled_each:
            self._n_spoiled = 0
            first_n, second_n = (self.force_gain * n + self.force_offset_n for n in force_n)
            force_n = first_n, second_n
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
        """Return what becomes of one message: any number of (arrival in s, length code, data)."""
        faults = self.faults
        faults.check()
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
