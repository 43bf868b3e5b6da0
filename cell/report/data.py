"""What the page of a run shows, as plain values; `cell.report.page.write_report` makes it of them.

Texts are shown as they are: markup in a label is escaped, never interpreted.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from recognition.recognizer import Posterior
from recognition.shape.answer import ShapeAnswer
from tactile.layout import TaxelLayout

HealthState = Literal["ok", "warn", "bad", "plain"]
"""How a figure of the links' health is marked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyFigure:
    """One large figure at the head of the page."""

    value: str
    caption: str
    note: str = ""
    """The figure with its unit, what it is, and in small what it rests on."""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifySequence:
    """One identification, grasp by grasp."""

    truth: str
    answer: str
    """What it really was, and what was answered."""
    posteriors: tuple[Posterior, ...] = ()
    notes: tuple[str, ...] = ()
    """Answer to each grasp by itself, and its pose and force for people."""
    shape: ShapeAnswer | None = None
    """Shape and size by all grasps; None where not asked for, or not felt."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConfusionTable:
    """What was held against what was named."""

    name: str
    """The recogniser."""
    labels: tuple[str, ...]
    columns: tuple[str, ...]
    """Objects held (rows) and answers (columns)."""
    counts: NDArray[np.int64]
    """(n_labels, n_columns) int64: trials."""
    caption: str = ""
    """What was counted."""

    def __post_init__(self) -> None:
        counts = np.array(self.counts, dtype=np.int64)
        if counts.shape != (len(self.labels), len(self.columns)) or np.any(counts < 0):
            raise ValueError(
                f"table {self.name!r}: counts of shape {counts.shape} do not fit "
                f"{len(self.labels)} rows and {len(self.columns)} columns"
            )
        counts.setflags(write=False)
        object.__setattr__(self, "counts", counts)


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthRow:
    """One figure of the links' health, and whether it is as it should be."""

    name: str
    value: str
    state: HealthState = "plain"
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthGroup:
    """Health of one link or loop."""

    title: str
    rows: tuple[HealthRow, ...]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PressureLevel:
    """What all taxels showed at one force."""

    caption: str
    """The force, for people: ``2.0 N``."""
    counts: NDArray[np.float64]
    """(n_taxels,) float64: counts, as a rule averaged over some frames."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspTimeline:
    """One grasp over time; NaN where a value is not known."""

    t_s: NDArray[np.float64]
    """(n,) float64: time in s."""
    force_n: NDArray[np.float64]
    """(n, 2) float64: tactile force on finger 0 and 1 in N."""
    setpoint_n: NDArray[np.float64]
    goal_current_a: NDArray[np.float64]
    aperture_m: NDArray[np.float64]
    """(n,) float64: set-point of the grip force in N, goal current in A, opening in m."""
    contact_t_s: float | None = None
    """Time of contact in s, None where there was none."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExampleGrasp:
    """One grasp that is shown in full."""

    label: str
    """What was grasped."""
    layout: TaxelLayout
    """The pads."""
    levels: tuple[PressureLevel, ...]
    """Pressure at rising forces."""
    timeline: GraspTimeline
    """The grasp over time."""
    note: str
    """Pose and the like, in small."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectTrajectory:
    """The paper's eigenvalue of one object."""

    label: str
    """The object."""
    sweep: NDArray[np.float64]
    """(n,) float64: smallest eigenvalue over the poses of Algorithm 1, in its order; may be empty.
    """
    ramp_force_n: NDArray[np.float64]
    ramp_value: NDArray[np.float64]
    """(m,) float64: smallest eigenvalue along the force ramp, and the force in N; may be empty."""
    low: float
    high: float
    """The object's level: least and largest taught value; NaN where it has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The gap between the levels of two neighbouring objects."""

    name: str
    """A, B, C ... as in the paper's Fig. 4."""
    below: str
    above: str
    """The neighbours."""
    low: float
    high: float
    """Edges; a window is closed where ``high <= low``."""
    threshold: float
    """The middle, the threshold between the two."""

    @property
    def closed(self) -> bool:
        """Whether the two levels overlap."""
        return self.high <= self.low


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectories:
    """The paper's eigenvalue trajectories, levels and windows of all objects."""

    objects: tuple[ObjectTrajectory, ...]
    windows: tuple[Window, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportData:
    """All that the page shows."""

    title: str
    created: str
    subtitle: str = ""
    """Heading, when it was made, and a line below."""
    key_figures: tuple[KeyFigure, ...] = ()
    """The result in a few large figures."""
    facts: tuple[tuple[str, str], ...] = ()
    """Description of the cell: name and value."""
    examples: tuple[ExampleGrasp, ...] = ()
    """One grasp of each object in full."""
    trajectories: Trajectories | None = None
    sequences: tuple[IdentifySequence, ...] = ()
    """The paper's method, where it was taught; all identifications."""
    confusions: tuple[ConfusionTable, ...] = ()
    """One table for each recogniser; `build.paper_table` gives the paper's."""
    health: tuple[HealthGroup, ...] = ()
    """Of the links and the force loop."""
    files: tuple[tuple[str, str], ...] = ()
    """Name and path of recording, data set and model."""
    notes: tuple[str, ...] = ()
    """What the figures rest on."""
