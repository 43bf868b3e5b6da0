"""The scanner of the control unit: from a scan to messages, with faults, tare and status."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from simulator.can.faults import ControlUnitFaults
from simulator.can.messages import MESSAGE_BYTES, BurstFormat
from simulator.can.pad_forces import PadForces
from tactile.control_unit.object_dictionary import UnitTareResult
from tactile.layout import TaxelLayout
from tactile.source import ForceStatus, FrameStatus


class ScannedWorld(Protocol):
    """The world for a scanner."""

    def scan(self) -> NDArray[np.uint16]:
        """Convert all taxels at this moment; counts (n_taxels,)."""

    def scan_gripping(self) -> NDArray[np.uint16]:
        """Convert the taxels of the gripping pads; counts (n_taxels,), 0 on the other pads."""


@dataclass(slots=True)
class _Tare:
    """A running tare: its parameters, and the scans so far."""

    frames_wanted: int
    touch_counts: int
    spread_counts: int
    frames: list[NDArray[np.uint16]]


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
        """Restore the state after power-on: no zero, no frame, counter at 0."""
        self.counter = 0xFFFF
        """Number of the last scan, modulo 65536."""
        self.read_counter = 0
        """Number of the scan in the last result of `last_frame`."""
        self.overrun = self.force_overrun = False
        """Whether the status of the next message reports that the previous one was late."""
        self.last_force = bytes(MESSAGE_BYTES)
        """The last force message."""
        self.forces.reset()
        self.tare_result = UnitTareResult.NONE
        self.tare_largest = 0
        """Objects 0x2130:02 and 0x2130:04."""
        self._offsets: NDArray[np.int32] | None = None
        self._tare: _Tare | None = None
        self._raw: NDArray[np.uint16] | None = None
        self._counts: NDArray[np.uint16] | None = None
        self._gripping: NDArray[np.uint16] | None = None

    def latch(self) -> None:
        """Take a scan: it becomes the frame with the next counter."""
        faults = self._faults
        if not faults.frozen or self._raw is None:
            self._raw = faults.apply(self._world.scan(), self._layout.adc_max)
        counts = self._raw
        if self._tare is not None:
            self._collect(self._tare, counts)
        if self._offsets is not None:
            counts = np.maximum(counts.astype(np.int32) - self._offsets, 0).astype(np.uint16)
        self._counts = counts
        self.counter = (self.counter + 1) & 0xFFFF

    def frame_messages(self) -> list[bytes]:
        """Return the burst of the latched frame."""
        status = FrameStatus(0)
        if self._offsets is not None:
            status |= FrameStatus.TARED
        if self._raw is not None and int(self._raw.max()) >= self._layout.adc_max:
            status |= FrameStatus.SATURATED
        if self.overrun:
            status |= FrameStatus.OVERRUN
            self.overrun = False
        return self.format.burst(self._latched(), self.counter, status)

    def force_message(self) -> bytes:
        """Scan the gripping pads and return their force message."""
        faults = self._faults
        if not faults.frozen or self._gripping is None:
            self._gripping = faults.apply(self._world.scan_gripping(), self._layout.adc_max)
        status = ForceStatus.OVERRUN if self.force_overrun else ForceStatus(0)
        self.force_overrun = False
        gripping = self._gripping.take(self._grip)
        self.last_force = self.forces.message(gripping, status, spoil=faults.spoil)
        return self.last_force

    def last_frame(self) -> bytes | None:
        """Return the samples of the last frame in bus format; None before the first frame.

        Scans continue during the upload: ``read_counter`` stays at this frame's number.
        """
        if self._counts is None:
            return None
        self.read_counter = self.counter
        return self.format.samples(self._counts)

    def start_tare(self, n_frames: int, touch_counts: int, spread_counts: int) -> None:
        """Take a zero from the next ``n_frames`` scans, unless they show touch or noise."""
        self._tare = _Tare(n_frames, touch_counts, spread_counts, [])
        self.tare_result = UnitTareResult.RUNNING
        self.tare_largest = 0

    def clear_tare(self) -> None:
        """Remove the tare: counts are raw again."""
        self._tare = None
        self._offsets = None
        self.tare_result = UnitTareResult.NONE

    def _latched(self) -> NDArray[np.uint16]:
        if self._counts is None:
            raise RuntimeError("no scan has been latched yet")
        return self._counts

    def _collect(self, tare: _Tare, counts: NDArray[np.uint16]) -> None:
        tare.frames.append(counts)
        self.tare_largest = max(self.tare_largest, int(counts.max()))
        if len(tare.frames) < tare.frames_wanted:
            return
        self._tare = None
        frames = np.stack(tare.frames).astype(np.int32)
        if self.tare_largest > tare.touch_counts:
            self.tare_result = UnitTareResult.REFUSED_TOUCHED
        elif int(np.ptp(frames, axis=0).max()) > tare.spread_counts:
            self.tare_result = UnitTareResult.REFUSED_SPREAD
        else:
            self._offsets = np.rint(frames.mean(axis=0)).astype(np.int32)
            self.tare_result = UnitTareResult.DONE
