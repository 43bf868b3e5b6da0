"""The scanner of the control unit: from a scan to messages, with faults and status."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from simulator.can.faults import ControlUnitFaults
from simulator.can.messages import BurstFormat
from simulator.can.pad_forces import PadForces
from tactile.layout import TaxelLayout
from tactile.source import ForceStatus, FrameStatus

FORCE_SCAN_S = 0.005
"""Longest time in s between two scans of the gripping pads (the unit's page, TPDO2)."""


class ScannedWorld(Protocol):
    """The world for a scanner."""

    def scan(self) -> NDArray[np.uint16]:
        """Convert all taxels at this moment; counts (n_taxels,)."""

    def scan_gripping(self) -> NDArray[np.uint16]:
        """Convert the taxels of the gripping pads; counts (n_taxels,), 0 on the other pads."""


class Scanner:
    """Latches scans and turns them into messages."""

    def __init__(self, world: ScannedWorld, layout: TaxelLayout, faults: ControlUnitFaults) -> None:
        self._world = world
        self._layout = layout
        self._faults = faults
        self.format = BurstFormat(layout.n_taxels, layout.sample_bytes)
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
        self.read_counter = 0
        """Number of the scan in the last result of `last_frame`."""
        self.overrun = self.force_overrun = False
        """Whether the status of the next message reports that the previous one was late."""
        self.forces.reset()
        self._counts: NDArray[np.uint16] | None = None
        self._gripping: NDArray[np.uint16] | None = None

    def frame_messages(self) -> list[bytes]:
        """Take a scan, the frame with the next counter, and return its burst."""
        faults = self._faults
        if not faults.frozen or self._counts is None:
            self._counts = faults.apply(self._world.scan(), self._layout.adc_max)
        self.counter = (self.counter + 1) & 0xFFFF
        saturated = int(self._counts.max()) >= self._layout.adc_max
        status = FrameStatus.SATURATED if saturated else FrameStatus(0)
        if self.overrun:
            status |= FrameStatus.OVERRUN
            self.overrun = False
        return self.format.burst(self._counts, self.counter, status)

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
        return self.forces.message(gripping, status, spoil=faults.spoil)

    def last_frame(self) -> bytes | None:
        """Return the samples of the last frame in bus format; None before the first frame.

        Scans continue during the upload: ``read_counter`` stays at this frame's number.
        """
        if self._counts is None:
            return None
        self.read_counter = self.counter
        return self.format.samples(self._counts)
