"""The values of a report page, for `cell.report.page.write_report`.

The page escapes all texts: markup in a label has no effect.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.control.answer import Answer
from cell.data.recording_reader import RecordedCycles
from recognition.evaluation.metrics import wilson_interval
from recognition.grasp import Grasp
from recognition.recognizer import UNKNOWN, Posterior
from tactile.layout import TaxelLayout

HealthState = Literal["ok", "warn", "bad", "plain"]
"""Mark of a value of the links' health."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answered(Answer):
    """Answer of a recorded identification."""

    fused: Posterior
    """Answer of all grasps together."""
    posteriors: tuple[Posterior, ...] = ()
    """Answer of each single grasp, in order; empty if not known."""
    notes: tuple[str, ...] = ()
    """Pose and force of each grasp; not of further ramps in the same grip."""
    grasps: tuple[Grasp, ...] = ()
    """The grasps, without further ramps in the same grip."""

    @property
    def name(self) -> str:
        """True name if known, else the answer."""
        return self.presented or self.label


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ShownGrasp:
    """One grasp with plots: the pads, and force, current and opening over time."""

    label: str
    note: str
    """Name of the held part; pose and force."""
    grasp: Grasp
    cycles: RecordedCycles
    """Its periods of the force loop."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyFigure:
    """One large value at the top of the page."""

    value: str
    caption: str
    note: str = ""
    """Value with unit, its meaning, and its basis in small print."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConfusionTable:
    """Counts of held objects and answers."""

    name: str
    """Source of the answers, as text."""
    labels: tuple[str, ...]
    columns: tuple[str, ...]
    """Objects held (rows) and answers (columns)."""
    counts: NDArray[np.int64]
    """(n_labels, n_columns) int64: trials."""
    caption: str = ""
    """Description of the trials."""

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
        """The counts as text: right, UNKNOWN and wrong answers."""
        n_unknown = int(self.counts[:, np.array(self.columns) == UNKNOWN].sum())
        unknown = f", {n_unknown} {UNKNOWN}" if n_unknown else ""
        wrong = self.n - self.n_right - n_unknown
        return f"{self.n_right} of {self.n} right{unknown}, {wrong} wrong"


@dataclass(frozen=True, slots=True, kw_only=True)
class HealthRow:
    """One value of the links' health, and its state."""

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
    """The object's level: smallest and largest taught value; NaN without a level."""


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
    """Edges; a window is closed if ``high <= low``."""
    threshold: float
    """Middle of the window: threshold between the two objects."""

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
    """All values of the page."""

    title: str
    created: str
    subtitle: str = ""
    """Heading, date, and a line below."""
    layout: TaxelLayout
    """The pads."""
    key_figures: tuple[KeyFigure, ...] = ()
    """The main results."""
    facts: tuple[tuple[str, str], ...] = ()
    """Description of the cell: name and value."""
    examples: tuple[ShownGrasp, ...] = ()
    """One grasp of each object."""
    trajectories: Trajectories | None = None
    """The paper's method, if it was taught."""
    sequences: tuple[Answered, ...] = ()
    """All identifications."""
    true_sizes: Mapping[str, str] = field(default_factory=dict)
    """True thicknesses of the simulated objects as text, by label."""
    confusions: tuple[ConfusionTable, ...] = ()
    """One table for each recogniser; `build.paper_table` gives the paper's."""
    health: tuple[HealthGroup, ...] = ()
    """Health of the links and the force loop."""
    files: tuple[tuple[str, str], ...] = ()
    """Name and path of recording, data set and model."""
    notes: tuple[str, ...] = ()
    """Basis and limits of the results."""
