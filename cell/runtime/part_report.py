"""The report of each part of a job, for programs that count parts: its answer with its last grasp.

It is made in the thread of the cell between two grasps, from received data of the force loop.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.config.model import CellConfig
from cell.config.tactile import make_calibration
from cell.control.answer import Answer
from cell.control.controller import CellController
from cell.control.identification import Identification
from cell.control.records import GraspRecord
from tactile.sensor.tare import TareResult
from tactile.sensor.taxel_forces import TaxelForces

POINTS_MAX = 300
"""Most points of a curve, enough for a display."""


OnPart = Callable[[Answer, Identification | None], None]
"""Called in the thread of the cell with each part, and its grasps; without a label and grasps for a
turn without a part."""
PartReporter = Callable[..., Answer]
"""Called by a task with the answer of a part and its grasps as `OnPart`; returns the answer with
the object that was brought and its time."""


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
    controller: CellController, newtons: TaxelNewtons, listeners: Sequence[OnPart]
) -> PartReporter:
    """Return the function with which a starting task reports its parts to all listeners."""
    since_s = controller.clock.monotonic()

    def seen(answer: Answer, found: Identification | None = None) -> Answer:
        nonlocal since_s
        before_s, since_s = since_s, controller.clock.monotonic()
        answer = replace(
            answer, presented=controller.journal.brought or "", seconds=since_s - before_s
        )
        curves = None if found is None else _curves(found.records[-1], newtons)
        for on_part in listeners:
            on_part(replace(answer, curves=curves), found)
        return answer

    return seen


def _curves(record: GraspRecord, newtons: TaxelNewtons) -> dict[str, Any]:
    """Return `Answer.curves`, with the frame of the highest load; NaN becomes None."""
    grasp, cycles = record.grasp, record.cycles
    at = np.unique(np.linspace(0, len(cycles) - 1, POINTS_MAX).round().astype(int))
    # By newtons: the noise of all taxels hides a light touch in the sum of the counts.
    frames_n = [one for counts in grasp.counts if (one := newtons.of(counts)) is not None]
    frame_n = max(frames_n, key=np.sum, default=None)

    def column(values: list[float]) -> list[float | None]:
        return [round(values[n], 3) if np.isfinite(values[n]) else None for n in at]

    return {
        "t_s": column([one.t_s - cycles[0].t_s for one in cycles]),
        "force_n": column([np.nan if one.force is None else one.force.grip_n for one in cycles]),
        "setpoint_n": column([one.setpoint_n for one in cycles]),
        "opening_mm": column([1e3 * one.state.aperture_m for one in cycles]),
        "frame": None if frame_n is None else [round(float(one), 3) for one in frame_n],
    }
