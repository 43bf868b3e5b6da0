"""The report of one part of a job, for programs that count parts: answer, place, time, grasp.

It is made in the thread of the cell between two grasps, from received data of the force loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.config.model import CellConfig
from cell.config.tactile import make_calibration
from cell.control.controller import CellController
from cell.control.identification import Identification
from cell.control.records import GraspRecord
from cell.plugin.answer import Answer
from tactile.sensor.tare import TareResult
from tactile.sensor.taxel_forces import TaxelForces

POINTS_MAX = 300
"""Most points of a curve, enough for a display."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PartReport:
    """One identified or sorted part, or one turn without a part."""

    number: int = 0
    """Its number since the program began, from 1; 0 for a turn without a part."""
    time_s: float = 0.0
    """Unix time in s at which it was counted."""
    task: str
    """``identify`` or ``sort``."""
    answer: Answer | None
    """None if no part was found."""
    found: Identification | None = field(default=None, repr=False, compare=False)
    """Data of the answer with all frames: megabytes, for listeners in this program. None if no part
    was found."""
    held: str = ""
    """Label of the brought object according to host, person or simulator; empty if not given."""
    label_id: int = 0
    """Id of its label, from 1; 0 for UNKNOWN."""
    place: str | None = None
    """Place where it was released; None outside of a sort."""
    place_id: int = 0
    """Number of that place, from 1, in the order of `Places.names`; 0 outside of a sort."""
    rejected: bool = False
    """Whether it has no name, or was released at the place of the rejects."""
    seconds: float
    """Time since the previous part, or since the start of the job, in s of the cell's clock."""
    curves: dict[str, Any] | None = None
    """The last grasp: ``t_s``, ``force_n``, ``setpoint_n``, ``opening_mm``, each a list with at
    most `POINTS_MAX` values. ``frame``: force in N of each taxel at the highest load."""

    def as_json(self) -> dict[str, Any]:
        """Return a part as plain data, without its curves; lengths in mm."""
        answer = self.answer
        if answer is None:
            raise ValueError("a turn without a part has no data")
        others = [(p, label) for label, p in answer.probabilities.items() if label != answer.label]
        second = max(others, default=None)
        shape = answer.shape
        return {
            "number": self.number,
            "time_s": self.time_s,
            "task": self.task,
            "label": answer.label,
            "label_id": self.label_id,
            "probability": answer.probability,
            "runner_up": second and {"label": second[1], "probability": second[0]},
            "shape": None if shape is None else shape.kind,
            "size_mm": None if shape is None else shape.size_mm,
            "interval_mm": None if shape is None else shape.interval_mm,
            "n_grasps": answer.n_grasps,
            "seconds": self.seconds,
            "place": self.place,
            "place_id": self.place_id,
        }


OnPart = Callable[[PartReport], None]
"""Called with each part, in the thread of the cell."""
PartCallback = Callable[..., None]
"""Called by a task with the `Identification` of a part, or None if no part was found, and with
further fields of `PartReport` by name."""


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


def part_reporter(
    task: str, controller: CellController, newtons: TaxelNewtons, listeners: Sequence[OnPart]
) -> PartCallback:
    """Return the function with which a starting task reports its parts to all listeners."""
    since_s = controller.clock.monotonic()

    def seen(found: Identification | None, **fields: Any) -> None:
        nonlocal since_s
        before_s, since_s = since_s, controller.clock.monotonic()
        report = PartReport(
            task=task,
            answer=None if found is None else Answer.of(found),
            found=found,
            held=controller.journal.brought or "",
            seconds=since_s - before_s,
            curves=None if found is None else _curves(found.records[-1], newtons),
            **fields,
        )
        for on_part in listeners:
            on_part(report)

    return seen


def _curves(record: GraspRecord, newtons: TaxelNewtons) -> dict[str, Any]:
    """Return `PartReport.curves`, with the frame of the highest load; NaN becomes None."""
    grasp, cycles = record.grasp, record.cycles
    at = np.unique(np.linspace(0, len(cycles) - 1, POINTS_MAX).round().astype(int))
    highest = int(np.argmax(grasp.counts.sum(axis=1, dtype=np.int64)))
    frame_n = newtons.of(grasp.counts[highest])

    def column(values: list[float]) -> list[float | None]:
        return [round(values[n], 3) if np.isfinite(values[n]) else None for n in at]

    return {
        "t_s": column([one.t_s - cycles[0].t_s for one in cycles]),
        "force_n": column([np.nan if one.force is None else one.force.grip_n for one in cycles]),
        "setpoint_n": column([one.setpoint_n for one in cycles]),
        "opening_mm": column([1e3 * one.state.aperture_m for one in cycles]),
        "frame": None if frame_n is None else [round(float(one), 3) for one in frame_n],
    }
