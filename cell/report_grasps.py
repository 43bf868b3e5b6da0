"""The parts of a report that show what was felt: pressure, course of a grasp, eigenvalues."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recognition.grasp import PadArray


def _freeze(owner: Any, *names: str) -> None:
    for name in names:
        array = np.array(getattr(owner, name))
        array.setflags(write=False)
        object.__setattr__(owner, name, array)


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
        The middle, at which the two are told apart.
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
