"""From the force loop's cycles and the sensor's frames to the record of one grasp."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from cell.pose import Pose
from cell.sequence import GraspStep
from gripper.gripper import Cycle, GraspOutcome
from recognition.early import EarlyAnswer
from recognition.grasp import Grasp, PadArray
from recognition.placing import Placing
from tactile.layout import TaxelLayout
from tactile.protocol import TactileFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspRecord:
    """One grasp of a sequence, with all that belongs to it.

    Attributes
    ----------
    grasp
        What the recognisers get.
    step
        What was planned.
    reached
        Pose that the positioner reached.
    outcome
        What the gripper says of it.
    cycles
        Every period of the force loop, in order.
    early
        What ended the ramp before its usual end; None where that was reached. The grasp holds what
        was felt until the force had settled, which is more than what decided.
    """

    grasp: Grasp
    step: GraspStep
    reached: Pose
    outcome: GraspOutcome
    cycles: tuple[Cycle, ...]
    early: EarlyAnswer | None = None

    @property
    def duration_s(self) -> float:
        """Time from the first move of the closing fingers to the end of the ramp in s."""
        return self.cycles[-1].t_s - self.cycles[0].t_s

    @property
    def ended(self) -> str:
        """Where and by what the ramp was ended early, in words; empty where it was not."""
        if self.early is None:
            return ""
        told = self.early.posterior
        return (
            f"ended early at {self.cycles[-1].setpoint_n:.1f} N: {told.best} "
            f"{100 * float(told.probability.max()):.1f} %"
        )

    def ramp_as_json(self) -> dict[str, Any]:
        """Return how the ramp ended, as plain data."""
        told = None if self.early is None else self.early.posterior
        return {
            "seconds": round(self.duration_s, 3),
            "wanted_n": self.step.force_n,
            "setpoint_n": self.cycles[-1].setpoint_n,
            "force_n": self.outcome.final_force_n,
            "ended_early": self.early is not None,
            "label": None if told is None else told.best,
            "probability": None if told is None else float(told.probability.max()),
        }


def pad_array(layout: TaxelLayout) -> PadArray:
    """Return the part of a layout that recognisers need."""
    return PadArray(
        pad_shape=np.asarray(layout.pad_shape),
        taxel_pad=np.asarray(layout.taxel_pad),
        taxel_xy_m=np.asarray(layout.taxel_xy_m),
        adc_max=layout.adc_max,
    )


class GraspCollector:
    """Collects one grasp: each frame with the opening and set-point of the period it came in."""

    def __init__(self) -> None:
        self._frames: list[TactileFrame] = []
        self._apertures_m: list[float] = []
        self._forces_n: list[float] = []
        self._cycles: list[Cycle] = []

    def add(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        """Take one period of the force loop and the frames that arrived in it."""
        self._cycles.append(cycle)
        for frame in frames:
            self._frames.append(frame)
            self._apertures_m.append(cycle.state.aperture_m)
            self._forces_n.append(cycle.setpoint_n)

    @property
    def n_frames(self) -> int:
        """Number of frames so far."""
        return len(self._frames)

    @property
    def cycles(self) -> tuple[Cycle, ...]:
        """All periods so far, in order."""
        return tuple(self._cycles)

    def grasp(
        self,
        pads: PadArray,
        *,
        label: str = "",
        shape: str = "",
        source: str = "",
        start_ms: int,
        placing: Placing | None = None,
    ) -> Grasp:
        """Return what was collected. Raises ValueError if no frame came."""
        if not self._frames:
            raise ValueError("no tactile frame came during the grasp")
        t_s = np.array([frame.t_s for frame in self._frames])
        return Grasp(
            pads=pads,
            counts=np.stack([frame.counts for frame in self._frames]),
            t_s=t_s - t_s[0],
            aperture_m=np.array(self._apertures_m),
            force_n=np.array(self._forces_n),
            label=label,
            shape=shape,
            source=source,
            start_ms=start_ms,
            placing=placing,
        )
