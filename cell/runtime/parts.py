"""The parts of a cell: each is filled once, in the thread of the cell, and all listeners get it."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.config.model import CellConfig
from cell.config.tactile import make_calibration
from cell.control.controller import CellController
from cell.control.identification import Identification
from cell.control.part import Part
from cell.control.records import GraspRecord
from cell.fault_catalogue import error_text
from cell.learning.taught_model import TaughtModel
from tactile.sensor.sensor import TaxelForces
from tactile.sensor.tare import TareResult

_POINTS_MAX = 300
"""Most points of a curve, enough for a display."""

OnPart = Callable[[Part, Identification | None], None]
"""Called in the thread of the cell with each part and its grasps; without a label and grasps for a
turn without a part. Its error is a note, and ends no job."""


@dataclass(slots=True)
class PartLog:
    """Makes the parts of a cell from identifications."""

    controller: CellController
    model: TaughtModel
    listeners: list[OnPart] = field(default_factory=list)
    """Called with each part."""
    last: Part | None = None
    """The part of the last identification, until the next identification or sort begins."""
    _n_parts: int = 0
    _job: tuple[int, str] = (0, "")
    _since_s: float = 0.0

    @property
    def labels(self) -> tuple[str, ...]:
        """Names by label id, from 1: ``serve.objects`` of the config, then other taught labels."""
        listed = self.model.config.serve.objects
        return (*listed, *(label for label in self.model.labels if label not in listed))

    def label_id(self, label: str) -> int:
        """Return the id of a label; 0 for UNKNOWN and for a label without an id."""
        labels = self.labels
        return labels.index(label) + 1 if label in labels else 0

    def begin(self, job: int, task: str) -> None:
        """Begin a job that finds parts."""
        self._job, self._since_s = (job, task), self.controller.clock.monotonic()

    def add(self, identification: Identification | None, remark: str = "", **fate: Any) -> Part:
        """Return the part of an identification; ``fate`` has what became of it.

        None: a turn without a part, which is a `Part` without a label.
        """
        before_s, self._since_s = self._since_s, self.controller.clock.monotonic()
        fields: dict[str, Any] = {}
        if identification is not None:
            unreached = (record.outcome.unreached for record in identification.records)
            self._n_parts += 1
            fields = fate | {
                "number": self._n_parts,
                "label": identification.label,
                "label_id": self.label_id(identification.label),
                "probabilities": identification.fused.probabilities,
                "n_grasps": len(identification.records),
                "n_ended_early": identification.n_ended_early,
                "shape": identification.shape,
                "drift": identification.drift,
                "remark": remark or next(filter(None, unreached), ""),
            }
        part = Part(
            job=self._job[0],
            task=self._job[1],
            time_s=time.time(),
            seconds=self._since_s - before_s,
            presented=self.controller.journal.brought or "",
            **fields,
        )
        for on_part in self.listeners:
            try:
                on_part(part, identification)
            except Exception as error:  # the part is named, and may be in the grip
                self.controller.journal.note("note", f"on_part failed: {error_text(error)}")
        return part


class TaxelNewtons:
    """Converts counts into newtons with the present zero of the cell."""

    def __init__(self, config: CellConfig, controller: CellController) -> None:
        self._controller = controller
        self._layout = controller.hand.layout
        self._calibration = make_calibration(config.tactile, self._layout)
        self._made: tuple[TareResult, TaxelForces] | None = None

    def of(self, counts: NDArray[np.uint16]) -> NDArray[np.float32] | None:
        """Return the force in N on each taxel, (n_taxels,) float32; None before the first zero."""
        zero, made = self._controller.zeroing.taxels, self._made
        if zero is None:
            return None
        if made is None or made[0] is not zero:
            made = self._made = (zero, TaxelForces(self._layout, self._calibration, zero))
        return made[1].of(counts)

    def curves(self, record: GraspRecord) -> dict[str, Any]:
        """Return a grasp as plain data: ``t_s``, ``force_n``, ``setpoint_n``, ``opening_mm``.

        These lists have equal length. ``frame`` has the force in N of each taxel at the highest
        load, or None. NaN becomes None.
        """
        cycles = record.cycles
        at = np.unique(np.linspace(0, len(cycles) - 1, _POINTS_MAX).round().astype(int))
        # By newtons: the noise of all taxels hides a light touch in the sum of the counts.
        frames_n = [load for counts in record.grasp.counts if (load := self.of(counts)) is not None]
        frame_n = max(frames_n, key=np.sum, default=None)

        def column(values: list[float]) -> list[float | None]:
            return [round(values[n], 3) if np.isfinite(values[n]) else None for n in at]

        return {
            "t_s": column([cycle.t_s - cycles[0].t_s for cycle in cycles]),
            "force_n": column(
                [np.nan if cycle.force is None else cycle.force.grip_n for cycle in cycles]
            ),
            "setpoint_n": column([cycle.setpoint_n for cycle in cycles]),
            "opening_mm": column([1e3 * cycle.state.aperture_m for cycle in cycles]),
            "frame": None if frame_n is None else [round(float(taxel_n), 3) for taxel_n in frame_n],
        }
