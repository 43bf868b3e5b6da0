"""Grasp records: the control periods and the tactile frames of one grasp."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.control.plan import GraspStep, Pose
from gripper.values.outcome import GraspOutcome
from gripper.values.state import Cycle, TimeSpan
from recognition.grasp import Grasp, GraspCommand, PadArray, SelfZero
from recognition.recognizer import Posterior
from tactile.errors import FrameTimeout
from tactile.layout import TaxelLayout
from tactile.source import TactileFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspRecord:
    """Record of one grasp of a sequence."""

    grasp: Grasp = field(repr=False)
    """Input of the recognizers."""
    step: GraspStep
    """Planned pose and force."""
    reached: Pose
    """Pose that the positioner reached."""
    outcome: GraspOutcome
    """Result of the gripper."""
    cycles: tuple[Cycle, ...] = field(repr=False)
    """Every period of the force loop, in order."""
    early: Posterior | None = None
    """Answer that ended the ramp early; None for a whole ramp. The grasp continues until the force
    has settled, so it has more frames than the answer used."""
    same_grip: bool = False
    """Whether this is a further ramp in the grip of the record before."""

    @property
    def duration_s(self) -> float:
        """Time from the first move of the closing fingers to the end of the ramp in s."""
        return self.cycles[-1].t_s - self.cycles[0].t_s

    @property
    def ended(self) -> str:
        """Where the ramp ended early, or with another force than asked for, as text; else empty."""
        if self.early is not None:
            return f"ended early at {self.cycles[-1].setpoint_n:.1f} N"
        return self.outcome.unreached

    def ramp_as_json(self) -> dict[str, Any]:
        """Return how the ramp ended, as plain data."""
        return {
            "seconds": round(self.duration_s, 3),
            "wanted_n": self.step.force_n,
            "setpoint_n": self.cycles[-1].setpoint_n,
            "force_n": self.outcome.final_force_n,
            "ended_early": self.early is not None,
            "label": None if self.early is None else self.early.best,
            "probability": None if self.early is None else float(self.early.probability.max()),
        }


def pad_array(layout: TaxelLayout) -> PadArray:
    """Return the geometry of a layout in the form that recognizers take."""
    return PadArray(
        pad_shape=np.asarray(layout.pad_shape),
        taxel_pad=np.asarray(layout.taxel_pad),
        taxel_xy_m=np.asarray(layout.taxel_xy_m),
        adc_max=layout.adc_max,
    )


@dataclass
class GraspCollector:
    """Collects the frames of one grasp, with opening and set-point of their control periods."""

    pads: PadArray
    _: KW_ONLY
    source: str
    start_ms: int
    zero: SelfZero | None = None
    """As in `recognition.grasp.Grasp`."""
    cycles: list[Cycle] = field(default_factory=list)
    """All periods so far, in order."""
    _frames: list[tuple[TactileFrame, Cycle]] = field(default_factory=list)

    def add(self, cycle: Cycle, frames: Sequence[TactileFrame]) -> None:
        """Add one period of the force loop and the frames that arrived in it."""
        self.cycles.append(cycle)
        self._frames += [(frame, cycle) for frame in frames]

    @property
    def n_frames(self) -> int:
        """Number of frames so far."""
        return len(self._frames)

    @property
    def counts(self) -> NDArray[np.uint16]:
        """Counts of all frames, (n_frames, n_taxels). Raises FrameTimeout if no frame came."""
        if not self._frames:
            raise FrameTimeout("no whole frame of the taxels came: check the line of the sensor")
        return np.stack([frame.counts for frame, _ in self._frames])

    def during(self, spans: Sequence[TimeSpan]) -> NDArray[np.int64]:
        """Return (n_frames,) int64: number of the span in which a frame came; -1 outside of all."""
        number = np.full(self.n_frames, -1)
        come_s = np.array([cycle.t_s for _, cycle in self._frames])
        for i, span in enumerate(spans):
            number[(come_s > span.since_s) & (come_s <= span.until_s)] = i
        return number

    def grasp(self, label: str = "", command: GraspCommand | None = None) -> Grasp:
        """Return the collected grasp. Raises FrameTimeout if no frame came."""
        counts = self.counts
        t_s = np.array([frame.t_s for frame, _ in self._frames])
        return Grasp(
            pads=self.pads,
            counts=counts,
            t_s=t_s - t_s[0],
            aperture_m=np.array([cycle.state.aperture_m for _, cycle in self._frames]),
            force_n=np.array([cycle.setpoint_n for _, cycle in self._frames]),
            label=label,
            source=self.source,
            start_ms=self.start_ms,
            command=command,
            zero=self.zero,
        )


def spliced(approach: Grasp, further: Grasp, from_n: float) -> Grasp:
    """Return a grasp made of the first approach and a further ramp in the same grip.

    A recognizer compares each taxel with its rest before the touch, but a further ramp begins with
    a loaded part. The frames of the first ramp below ``from_n``, the set-point in N at which the
    further ramp begins, are therefore put before it.
    """
    n = int(np.argmax(np.asarray(approach.force_n) >= from_n))
    gap_s = float(np.median(np.diff(further.t_s))) if further.n_frames > 1 else 0.0
    later_s = float(approach.t_s[n - 1]) + gap_s if n else 0.0
    return replace(
        further,
        counts=np.concatenate([approach.counts[:n], further.counts]),
        t_s=np.concatenate([approach.t_s[:n], further.t_s + later_s]),
        aperture_m=np.concatenate([approach.aperture_m[:n], further.aperture_m]),
        force_n=np.concatenate([approach.force_n[:n], further.force_n]),
    )
