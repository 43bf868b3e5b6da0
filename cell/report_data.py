"""What a report page shows, as plain values: every part may be empty and is then left out.

Teaching, identifying, evaluating and replaying fill different parts of the same `ReportData`;
`cell.report.write_report` makes the page of it. Texts are shown as they are: markup in a label is
escaped, never interpreted.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cell.report_grasps import ExampleGrasp, Trajectories
from cell.report_shapes import ShapeRow
from recognition.recognizer import Posterior
from recognition.shape_answer import ShapeAnswer

HealthState = Literal["ok", "warn", "bad", "plain"]
"""How a figure of the links' health is marked."""


@dataclass(frozen=True, slots=True, kw_only=True)
class KeyFigure:
    """One large figure at the head of the page.

    Attributes
    ----------
    value, caption, note
        The figure with its unit, what it is, and in small what it rests on.
    """

    value: str
    caption: str
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifyStep:
    """One grasp of an identification.

    Attributes
    ----------
    single, fused
        What this grasp tells by itself, and what all grasps so far tell together.
    note
        Pose and force, for people.
    """

    single: Posterior
    fused: Posterior
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class IdentifySequence:
    """One identification, grasp by grasp.

    Attributes
    ----------
    truth
        What it really was; None where nobody knows.
    answer, probability
        What was answered, and how probable that is.
    steps
        The grasps in order.
    shape
        Shape and size by all grasps; None where nobody asked, or none of them tells.
    """

    truth: str | None
    answer: str
    probability: float
    steps: tuple[IdentifyStep, ...]
    shape: ShapeAnswer | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ConfusionTable:
    """What was held against what was named.

    Attributes
    ----------
    name, caption
        The recogniser, and what was counted.
    labels, columns
        Objects held (rows) and answers (columns).
    counts : (n_labels, n_columns) int64
        Trials.
    """

    name: str
    labels: tuple[str, ...]
    columns: tuple[str, ...]
    counts: NDArray[np.int64]
    caption: str = ""

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


@dataclass(frozen=True, slots=True, kw_only=True)
class FileEntry:
    """A file that belongs to the report."""

    name: str
    path: str
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportData:
    """All that the page shows; each part but the title may be empty.

    Attributes
    ----------
    title, subtitle, created
        Heading, a line below it, and when it was made.
    key_figures
        The result in a few large figures.
    facts
        Description of the cell: name and value.
    examples
        One grasp of each object in full.
    trajectories
        The paper's eigenvalue trajectories.
    sequences
        Identifications, grasp by grasp.
    shapes
        Shape and size by each identification, also of those that `sequences` leaves out.
    confusions
        One table for each recogniser; `report_build.paper_table` gives the paper's.
    health
        Of the links and the force loop.
    files
        Where recording, data set and model lie.
    notes
        What a reader must know to judge the figures.
    """

    title: str
    created: str
    subtitle: str = ""
    key_figures: tuple[KeyFigure, ...] = ()
    facts: tuple[tuple[str, str], ...] = ()
    examples: tuple[ExampleGrasp, ...] = ()
    trajectories: Trajectories | None = None
    sequences: tuple[IdentifySequence, ...] = ()
    shapes: tuple[ShapeRow, ...] = ()
    confusions: tuple[ConfusionTable, ...] = ()
    health: tuple[HealthGroup, ...] = ()
    files: tuple[FileEntry, ...] = ()
    notes: tuple[str, ...] = ()
