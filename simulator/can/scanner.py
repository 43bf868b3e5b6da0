"""Scanner of the control unit: from a scan to messages, with faults and status.

Its codec has pure functions, written from docs/reference/control-unit.md and separate from the
driver's codec: an error in one of them shows as a disagreement.
"""

import struct
from binascii import crc_hqx
from dataclasses import dataclass
from functools import cache
from math import ceil

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from simulator.can.faults import ControlUnitFaults
from simulator.world.world import PhysicalWorld
from tactile.layout import TaxelLayout
from tactile.source import ForceMessage, ScanStatus

MESSAGE_BYTES = 8
FORCE_COUNTERS = 16
"""Number of different counters of force messages."""
TABLE_NODES = 129
"""Forces in the table of one pad, at even steps from 0 counts to full scale."""

_TRAILER_BYTES = 5
"""Counter, status and CRC at the end of a burst."""
_SHORT_BURST = 64
"""Most messages of a burst with one-byte headers: six bits for the number."""
_TABLE_STEP_N = 0.0005
_ZERO_STEPS = 60_000
"""Steps of a zero in the full scale of the counts."""
_FAILING = 0xFFFF
"""Zero of a failing taxel."""
_FORCE_STEPS_N, _CENTRE_STEPS_TAXELS = 500, 16
"""Steps of a force in 1 N, and of a centre in one pitch of the taxels."""
_NOWHERE = -128
"""Centre of a zero force."""


class DamagedObject(ValueError):
    """An object that the host wrote has a wrong length or a wrong CRC."""


@dataclass(frozen=True, slots=True)
class BurstFormat:
    """The division of a scan into the messages of one burst, as in object 2101h."""

    n_taxels: int
    sample_bytes: int

    @property
    def header_bytes(self) -> int:
        """One if six bits are enough for the number of messages, else two."""
        return 1 if self._content_bytes <= _SHORT_BURST * (MESSAGE_BYTES - 1) else 2

    @property
    def n_messages(self) -> int:
        """Messages of one burst."""
        return ceil(self._content_bytes / (MESSAGE_BYTES - self.header_bytes))

    @property
    def _content_bytes(self) -> int:
        return self.n_taxels * self.sample_bytes + _TRAILER_BYTES

    def samples(self, counts: NDArray[np.uint16]) -> bytes:
        """Return the samples of a scan, as the burst has them."""
        return counts.astype("<u1" if self.sample_bytes == 1 else "<u2").tobytes()

    def burst(self, counts: NDArray[np.uint16], counter: int, status: int) -> list[bytes]:
        """Return the messages of a scan with counts (n_taxels,), in the order of sending."""
        samples = self.samples(counts)
        header_bytes, n_messages = self.header_bytes, self.n_messages
        size = MESSAGE_BYTES - header_bytes
        filling = bytes(n_messages * size - len(samples) - _TRAILER_BYTES)
        checked = samples + filling + struct.pack("<HB", counter, status)
        data = checked + struct.pack("<H", crc_hqx(checked, 0xFFFF))
        heads = _heads(header_bytes, n_messages, counter % 4)
        return [head + data[n * size : (n + 1) * size] for n, head in enumerate(heads)]


@cache
def _heads(header_bytes: int, n_messages: int, phase: int) -> tuple[bytes, ...]:
    """Return the heads of the messages of a burst: its phase, and the number of each."""
    first = phase << 8 * header_bytes - 2
    return tuple((first | n).to_bytes(header_bytes, "big") for n in range(n_messages))


def force_bytes(message: ForceMessage) -> bytes:
    """Return a force message; values are limited to their range."""
    along, across = (
        (_NOWHERE, _NOWHERE)
        if message.centre_taxels is None
        else (_within(127, place * _CENTRE_STEPS_TAXELS) for place in message.centre_taxels)
    )
    first, second = (_within(32767, force_n * _FORCE_STEPS_N) for force_n in message.force_n)
    head = message.status << 4 | message.counter
    checked = struct.pack("<B2h2b", head, first, second, along, across)
    return checked + bytes((_crc8(checked),))


def read_table(data: bytes) -> NDArray[np.float64]:
    """Return the forces in N of object 2141h, (2, `TABLE_NODES`). DamagedObject for another."""
    return _numbers(data, 2 * TABLE_NODES).reshape(2, TABLE_NODES) * _TABLE_STEP_N


def read_zero(
    data: bytes, n_taxels: int, adc_max: int
) -> tuple[float, NDArray[np.float64], NDArray[np.bool_]]:
    """Return threshold, zeros (n,) in counts and failing taxels (n,) of object 2142h.

    DamagedObject for another.
    """
    steps = _numbers(data, 1 + n_taxels)
    counts = steps * (adc_max / _ZERO_STEPS)
    return float(counts[0]), counts[1:], steps[1:] == _FAILING


def _numbers(data: bytes, n: int) -> NDArray[np.float64]:
    # The CRC of this kind over data with their CRC, high byte first, is zero.
    if len(data) != 2 * n + 2 or crc_hqx(data[:-2] + data[:-3:-1], 0xFFFF):
        raise DamagedObject(f"{len(data)} bytes where {2 * n + 2} were expected, or a wrong CRC")
    return np.frombuffer(data, "<u2", n).astype(np.float64)


def _within(limit: int, steps: float) -> int:
    return min(max(round(steps), -limit), limit)


def _crc8(data: bytes) -> int:
    """Return the CRC-8 of SAE J1850: polynomial 1Dh, start and final inversion FFh."""
    remainder = 0xFF
    for byte in data:
        remainder = _CRC8_OF[remainder ^ byte]
    return remainder ^ 0xFF


def _divided(byte: int) -> int:
    for _ in range(8):
        byte = byte << 1 ^ (0x11D if byte & 0x80 else 0)
    return byte


_CRC8_OF = bytes(map(_divided, range(256)))


FORCE_SCAN_S = 0.005
"""Longest time in s between two scans of the gripping pads (the unit's page, TPDO2)."""


_MEAN_SCANS = 4
"""Scans in the running mean that decides about touch: 20 ms at 200 scans per second."""
_KERNEL = (2.0, 1.0)
"""Weights of a taxel and of each neighbour in each direction of the 3 x 3 mean (binomial)."""
_KERNEL_SUM = 16.0
"""Sum of all nine, also at a border: with a smaller sum noise would count as touch there."""
_FACING_SHARE = 0.7
"""Share of the threshold for a taxel and its facing taxel together: noise exceeds it on both less
often than it exceeds the whole threshold on one."""

_NODES = np.arange(TABLE_NODES)


def _smoothing(rows: int, columns: int) -> NDArray[np.float64]:
    """Return the matrix (n, n) that sums each taxel's 3 x 3 neighbours on its pad."""
    centre, neighbour = _KERNEL

    def band(n: int) -> NDArray[np.float64]:
        return centre * np.eye(n) + neighbour * (np.eye(n, k=1) + np.eye(n, k=-1))

    return np.asarray(np.kron(band(rows), band(columns)), dtype=np.float64)


class PadForces:
    """The sum of the force on both gripping pads, from one scan to one force message.

    The counts of a scan are relative to the zero from the host. A touched taxel adds the force of
    the host's table; other taxels add nothing, because their noise would hide a light touch. For
    the decision the mean over the last scans is smoothed over the 3 x 3 neighbours. A taxel becomes
    touched above the threshold, or if it and the facing taxel are above a share of it. It stays
    touched until the mean is back at zero. So a single scan never decides, and noise enters the
    force once, unclipped.
    """

    def __init__(self, layout: TaxelLayout) -> None:
        first, second = (layout.pads[pad] for pad in layout.gripping_pads)
        self._adc_max = layout.adc_max
        self._n_first = first.n_taxels
        pitch_m = np.array([first.pitch_x_m, first.pitch_y_m])
        self._place = np.concatenate([first.taxel_xy_m(), second.taxel_xy_m()]) / pitch_m
        self._smoothing = block_diag(
            _smoothing(first.rows, first.columns), _smoothing(second.rows, second.columns)
        )
        self._counter = 0
        self.reset()

    def reset(self) -> None:
        """Restore the state after power-on: no table, no zero."""
        self._table_n: NDArray[np.float64] | None = None
        self._zero_counts: NDArray[np.float64] | None = None
        self._touch_counts = 0.0
        self._bad = self._active = np.zeros(len(self._place), dtype=np.bool_)
        self._mean = np.zeros(len(self._place))

    def take_table(self, data: bytes) -> None:
        """Take object 0x2141; DamagedObject if it is damaged, the old table then stays."""
        self._table_n = read_table(data)

    def take_zero(self, data: bytes) -> None:
        """Take object 0x2142; DamagedObject if it is damaged, the old zero then stays."""
        decoded = read_zero(data, len(self._place), self._adc_max)
        self._touch_counts, self._zero_counts, self._bad = decoded
        self._active = np.zeros(len(self._place), dtype=np.bool_)
        self._mean = np.zeros(len(self._place))

    def message(self, counts: NDArray[np.uint16], status: ScanStatus) -> ForceMessage:
        """Return the next message.

        Parameters
        ----------
        counts : (n,) uint16
            Scan of both gripping pads, finger 0 first.
        status
            Status of this scan.
        """
        if np.count_nonzero((counts >= self._adc_max) & ~self._bad):
            status |= ScanStatus.SATURATED
        force_n, centre = self.scan(counts), None
        if self._table_n is not None and self._zero_counts is not None:
            status |= ScanStatus.ZEROED
        if (total_n := float(np.add.reduce(force_n))) > 0.0:
            x, y = force_n @ self._place / total_n
            centre = (float(x), float(y))
        self._counter = (self._counter + 1) % FORCE_COUNTERS
        n = self._n_first
        return ForceMessage(
            t_s=0.0,
            counter=self._counter,
            status=status,
            force_n=(float(np.add.reduce(force_n[:n])), float(np.add.reduce(force_n[n:]))),
            centre_taxels=centre,
        )

    def scan(self, counts: NDArray[np.uint16]) -> NDArray[np.float64]:
        """Take a scan, and return the force in N on each touched taxel, 0 on the others, (n,)."""
        if self._table_n is None or self._zero_counts is None:
            return np.zeros(len(counts))
        tared = counts - self._zero_counts
        if np.count_nonzero(self._bad):
            good = self._smoothing[self._bad] * ~self._bad
            tared[self._bad] = good @ tared / np.maximum(good.sum(axis=1), 1.0)
        self._mean += (tared - self._mean) / _MEAN_SCANS
        smooth = self._smoothing @ self._mean / _KERNEL_SUM
        self._active = (smooth > self._touch_counts) | (self._active & (smooth > 0.0))
        if len(smooth) == 2 * self._n_first:
            facing = smooth.reshape(2, -1).min(axis=0) > _FACING_SHARE * self._touch_counts
            both = self._active.reshape(2, -1)
            both |= facing
        force_n = np.zeros(len(tared))
        if not np.count_nonzero(self._active):
            return force_n
        touched = self._smoothing @ self._active.astype(np.float64) > 0.0
        node = tared * ((TABLE_NODES - 1) / self._adc_max)
        n = self._n_first
        for table_n, part in zip(self._table_n, (slice(None, n), slice(n, None)), strict=True):
            # Below zero the table continues with its first segment, so that noise averages out.
            below_n = np.minimum(node[part], 0.0) * (table_n[1] - table_n[0])
            force_n[part] = np.interp(node[part], _NODES, table_n) + below_n
        return np.where(touched, force_n, 0.0)


class Scanner:
    """Latches scans and turns them into messages."""

    def __init__(
        self, world: PhysicalWorld, layout: TaxelLayout, faults: ControlUnitFaults
    ) -> None:
        self._world = world
        self._layout = layout
        self._faults = faults
        self.format = BurstFormat(layout.n_taxels, layout.sample_bits // 8)
        """Division of scans into messages."""
        self.forces = PadForces(layout)
        """The sum of the force on the gripping pads."""
        self._grip = np.concatenate(
            [np.arange(layout.n_taxels)[layout.taxels_of(pad)] for pad in layout.gripping_pads]
        )
        self.reset()

    def reset(self) -> None:
        """Restore the state after power-on: no frame, counter at 0."""
        self.counter = 0xFFFF
        """Number of the last scan, modulo 65536."""
        self.overrun = self.force_overrun = False
        """Whether the status of the next message reports that the previous one was late."""
        self.forces.reset()
        self.counts: NDArray[np.uint16] | None = None
        """(n_taxels,) uint16: counts of the last frame; None before the first one."""
        self._gripping: NDArray[np.uint16] | None = None

    def frame_messages(self) -> list[bytes]:
        """Take a scan, the frame with the next counter, and return its burst."""
        faults = self._faults
        if not faults.frozen or self.counts is None:
            self.counts = faults.apply(self._world.scan(), self._layout.adc_max)
        self.counter = (self.counter + 1) & 0xFFFF
        saturated = int(self.counts.max()) >= self._layout.adc_max
        status = ScanStatus.SATURATED if saturated else ScanStatus(0)
        if self.overrun:
            status |= ScanStatus.OVERRUN
            self.overrun = False
        return self.format.burst(self.counts, self.counter, status)

    def force_message(self, period_s: float) -> bytes:
        """Scan the gripping pads and return their force message, one each ``period_s`` s."""
        faults = self._faults
        scans = max(1, round(period_s / FORCE_SCAN_S))
        for scan in range(1, scans + 1):
            if not faults.frozen or self._gripping is None:
                self._gripping = faults.apply(self._world.scan_gripping(), self._layout.adc_max)
            gripping = self._gripping.take(self._grip)
            if scan < scans:
                self.forces.scan(gripping)
        status = ScanStatus.OVERRUN if self.force_overrun else ScanStatus(0)
        self.force_overrun = False
        return force_bytes(faults.spoil(self.forces.message(gripping, status)))
