"""What the page of a run shows, as plain values; `cell.report.page.write_report` makes it of them.

Texts are shown as they are: markup in a label is escaped, never interpreted.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.data.recording_reader import RecordedCycles
from recognition.evaluation.metrics import wilson_interval
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Posterior
from recognition.shape.answer import ShapeAnswer
from tactile.layout import TaxelLayout

HealthState = Literal["ok", "warn", "bad", "plain"]
"""How a figure of the links' health is marked."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answered:
    """One identification."""

    truth: str
    """What it really was; empty where nobody has named it."""
    label: str
    """The answer."""
    fused: Posterior
    """Answer to all grasps together."""
    posteriors: tuple[Posterior, ...] = ()
    """Answer to each grasp by itself, in order; empty where they are not known."""
    n_grasps: int = 1
    """Number of grasps."""
    notes: tuple[str, ...] = ()
    """Pose and force of each grasp; further ramps in the same grip have none."""
    grasps: tuple[Grasp, ...] = ()
    """The grasps; further ramps in the same grip are not among them."""
    whole_ramps: bool = True
    """Whether no ramp was ended before its force."""
    shape: ShapeAnswer | None = None
    """Shape and size by all grasps; None where none of them shows it."""
    place: str = ""
    """Where a sort has let it go; empty for no sort."""

    @property
    def name(self) -> str:
        """What it was, as far as that is known."""
        return self.truth or self.label


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShownGrasp:
    """One grasp that is drawn: the pads, and force, current and opening over time."""

    label: str
    note: str
    """What was held, pose and force."""
    grasp: Grasp
    cycles: RecordedCycles
    """Its periods of the force loop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyFigure:
    """One large figure at the head of the page."""

    value: str
    caption: str
    note: str = ""
    """The figure with its unit, what it is, and in small what it rests on."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConfusionTable:
    """What was held against what was named."""

    name: str
    """Whose answers they are, in words."""
    labels: tuple[str, ...]
    columns: tuple[str, ...]
    """Objects held (rows) and answers (columns)."""
    counts: NDArray[np.int64]
    """(n_labels, n_columns) int64: trials."""
    caption: str = ""
    """What was counted."""

    @property
    def n(self) -> int:
        """Number of trials."""
        return int(self.counts.sum())

    @property
    def n_right(self) -> int:
        """Right answers."""
        return sum(
            int(self.counts[row, self.columns.index(label)])
            for row, label in enumerate(self.labels)
            if label in self.columns
        )

    @property
    def accuracy(self) -> float:
        """Share of right answers; NaN without a trial."""
        return self.n_right / self.n if self.n else float("nan")

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval (Wilson)."""
        return wilson_interval(self.n_right, self.n)

    @property
    def text(self) -> str:
        """The counts as text: right, UNKNOWN and wrong ones of all."""
        n_unknown = int(self.counts[:, np.array(self.columns) == UNKNOWN].sum())
        unknown = f", {n_unknown} {UNKNOWN}" if n_unknown else ""
        wrong = self.n - self.n_right - n_unknown
        return f"{self.n_right} of {self.n} right{unknown}, {wrong} wrong"


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
    layout: TaxelLayout
    """The pads."""
    key_figures: tuple[KeyFigure, ...] = ()
    """The result in a few large figures."""
    facts: tuple[tuple[str, str], ...] = ()
    """Description of the cell: name and value."""
    examples: tuple[ShownGrasp, ...] = ()
    """One grasp of each object."""
    trajectories: Trajectories | None = None
    """The paper's method, where it was taught."""
    sequences: tuple[Answered, ...] = ()
    """All identifications."""
    confusions: tuple[ConfusionTable, ...] = ()
    """One table for each recogniser; `build.paper_table` gives the paper's."""
    health: tuple[HealthGroup, ...] = ()
    """Of the links and the force loop."""
    files: tuple[tuple[str, str], ...] = ()
    """Name and path of recording, data set and model."""
    notes: tuple[str, ...] = ()
    """What the figures rest on."""
