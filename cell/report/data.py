"""What a report page shows, as plain values: every part may be empty and is then left out.

Teaching, identifying, evaluating and replaying fill different parts of the same `ReportData`;
`cell.report.page.write_report` makes the page of it. Texts are shown as they are: markup in a label
is escaped, never interpreted.
"""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray
from recognition.recognizer import Posterior
from recognition.shape.answer import ShapeAnswer

HealthState = Literal["ok", "warn", "bad", "plain"]
"""How a figure of the links' health is marked."""


def _freeze(owner: Any, *names: str) -> None:
    for name in names:
        array = np.array(getattr(owner, name))
        array.setflags(write=False)
        object.__setattr__(owner, name, array)


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
        By this grasp alone, and by all grasps so far.
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
        What it really was; None where that is not known.
    answer
        What was answered.
    steps
        The grasps in order.
    shape
        Shape and size by all grasps; None where not asked for, or not felt.
    """

    truth: str | None
    answer: str
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
class ShapeRow:
    """Shape and size by one identification.

    Attributes
    ----------
    truth
        What it really was; None where that is not known.
    answer
        What it was named.
    shape
        Shape and size by all of its grasps; None where none was felt.
    """

    truth: str | None
    answer: str
    shape: ShapeAnswer | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PadView:
    """What is known of a pad beyond its taxels.

    Attributes
    ----------
    name
        Shown beside its map.
    finger
        0 or 1.
    gripping
        Whether it is the finger's inner pad, which is shown large.
    """

    name: str
    finger: int
    gripping: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PressureLevel:
    """What all taxels showed at one force.

    Attributes
    ----------
    caption
        The force, for people: ``2.0 N``.
    counts : (n_taxels,) float64
        Counts, as a rule averaged over some frames.
    """

    caption: str
    counts: NDArray[np.float64]

    def __post_init__(self) -> None:
        _freeze(self, "counts")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GraspTimeline:
    """One grasp over time; NaN where a value is not known.

    Attributes
    ----------
    t_s : (n,) float64
        Time in s.
    force_n : (n, 2) float64
        Tactile force on finger 0 and 1 in N.
    setpoint_n, goal_current_a, aperture_m : (n,) float64
        Set-point of the grip force in N, goal current in A, opening in m.
    contact_t_s
        Time of contact in s, None where there was none.
    """

    t_s: NDArray[np.float64]
    force_n: NDArray[np.float64]
    setpoint_n: NDArray[np.float64]
    goal_current_a: NDArray[np.float64]
    aperture_m: NDArray[np.float64]
    contact_t_s: float | None = None

    def __post_init__(self) -> None:
        _freeze(self, "t_s", "force_n", "setpoint_n", "goal_current_a", "aperture_m")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ExampleGrasp:
    """One grasp that is shown in full.

    Attributes
    ----------
    label
        What was grasped.
    pads, pad_views
        The pads, and what is known of each, in the same order.
    levels
        Pressure at rising forces.
    timeline
        The grasp over time, if known.
    note
        Pose and the like, in small.
    """

    label: str
    pads: PadArray
    pad_views: tuple[PadView, ...]
    levels: tuple[PressureLevel, ...]
    timeline: GraspTimeline | None = None
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObjectTrajectory:
    """The paper's eigenvalue of one object.

    Attributes
    ----------
    label
        The object.
    sweep : (n,) float64
        Smallest eigenvalue over the poses of Algorithm 1, in its order; may be empty.
    ramp_force_n, ramp_value : (m,) float64
        Smallest eigenvalue along the force ramp, and the force in N; may be empty.
    low, high
        The object's level: least and largest taught value; NaN where it has none.
    """

    label: str
    sweep: NDArray[np.float64]
    ramp_force_n: NDArray[np.float64]
    ramp_value: NDArray[np.float64]
    low: float
    high: float

    def __post_init__(self) -> None:
        _freeze(self, "sweep", "ramp_force_n", "ramp_value")


@dataclass(frozen=True, slots=True, kw_only=True)
class Window:
    """The gap between the levels of two neighbouring objects.

    Attributes
    ----------
    name
        A, B, C ... as in the paper's Fig. 4.
    below, above
        The neighbours.
    low, high
        Edges; a window is closed where ``high <= low``.
    threshold
        The middle, the threshold between the two.
    """

    name: str
    below: str
    above: str
    low: float
    high: float
    threshold: float

    @property
    def closed(self) -> bool:
        """Whether the two levels overlap."""
        return self.high <= self.low


@dataclass(frozen=True, slots=True, kw_only=True)
class Trajectories:
    """The paper's eigenvalue trajectories, levels and windows of all objects."""

    objects: tuple[ObjectTrajectory, ...]
    windows: tuple[Window, ...] = ()
    caption: str = ""


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
        One table for each recogniser; `build.paper_table` gives the paper's.
    health
        Of the links and the force loop.
    files
        Where recording, data set and model lie.
    notes
        What the figures rest on.
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
