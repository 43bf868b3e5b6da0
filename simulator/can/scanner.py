"""The scanner of the control unit: from a scan to messages, with faults and status."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from simulator.can.faults import ControlUnitFaults
from simulator.can.messages import (
    FORCE_COUNTERS,
    TABLE_NODES,
    BurstFormat,
    force_bytes,
    read_table,
    read_zero,
)
from tactile.layout import TaxelLayout
from tactile.source import ForceMessage, ForceStatus, FrameStatus

FORCE_SCAN_S = 0.005
"""Longest time in s between two scans of the gripping pads (the unit's page, TPDO2)."""


class ScannedWorld(Protocol):
    """The world for a scanner."""

    def scan(self) -> NDArray[np.uint16]:
        """Convert all taxels at this moment; counts (n_taxels,)."""

    def scan_gripping(self) -> NDArray[np.uint16]:
        """Convert the taxels of the gripping pads; counts (n_taxels,), 0 on the other pads."""


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

    def message(self, counts: NDArray[np.uint16], status: ForceStatus) -> ForceMessage:
        """Return the next message.

        Parameters
        ----------
        counts : (n,) uint16
            Scan of both gripping pads, finger 0 first.
        status
            Status of this scan.
        """
        if np.count_nonzero((counts >= self._adc_max) & ~self._bad):
            status |= ForceStatus.SATURATED
        force_n, centre = self.scan(counts), None
        if self._table_n is not None and self._zero_counts is not None:
            status |= ForceStatus.ZEROED
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

    def __init__(self, world: ScannedWorld, layout: TaxelLayout, faults: ControlUnitFaults) -> None:
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
        status = FrameStatus.SATURATED if saturated else FrameStatus(0)
        if self.overrun:
            status |= FrameStatus.OVERRUN
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
        status = ForceStatus.OVERRUN if self.force_overrun else ForceStatus(0)
        self.force_overrun = False
        return force_bytes(faults.spoil(self.forces.message(gripping, status)))
