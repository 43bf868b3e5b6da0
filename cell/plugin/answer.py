"""The answer of an identification for a host program: plain values, lengths in mm."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

from cell.control.states import CellStatus
from recognition.recognizer import UNKNOWN

if TYPE_CHECKING:
    from cell.control.identification import Identification
    from cell.control.keeping import HeldCheck
    from cell.control.live import LiveValues
    from recognition.drift.grid import DriftGrid
    from recognition.shape.answer import ShapeAnswer


@dataclass(frozen=True, slots=True, kw_only=True)
class FeltShape:
    """Shape and size of an object, lengths in mm."""

    kind: str
    """``sphere``, ``oval``, ``cylinder``, ``flat``, ``dumbbell``, or ``unclear``."""
    probability: float
    """Probability of the likeliest kind, given that the shape is one of these kinds."""
    probabilities: Mapping[str, float] = field(hash=False)
    """Probability of each kind."""
    size_mm: float
    interval_mm: tuple[float, float]
    """Thickness along the closing axis (the diameter of a round part), and its 90 % interval."""
    thicknesses_mm: tuple[tuple[float, float, float], ...]
    """All measured thicknesses: size, and both ends of the interval."""
    dimensions_mm: Mapping[str, float] = field(hash=False)
    """Dimensions of the likeliest kind by their names, without interval."""
    n_grasps: int
    """Number of grasps that it is based on."""

    def __str__(self) -> str:
        sizes = (f"{at:.1f} mm ({low:.1f} to {high:.1f})" for at, low, high in self.thicknesses_mm)
        return f"{self.kind}, {' and '.join(sizes)}"

    @classmethod
    def of(cls, shape: "ShapeAnswer") -> Self:
        """Return an answer of shape and size in mm."""
        return cls(
            kind=shape.kind,
            probability=shape.probability[shape.likeliest],
            probabilities=dict(shape.probability),
            size_mm=1e3 * shape.size_m,
            interval_mm=(1e3 * shape.low_m, 1e3 * shape.high_m),
            thicknesses_mm=tuple(
                (1e3 * t.size_m, 1e3 * t.low_m, 1e3 * t.high_m) for t in shape.thicknesses
            ),
            dimensions_mm={name: 1e3 * value for name, value in shape.dimensions_m.items()},
            n_grasps=shape.n_grasps,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Answer of an identification."""

    label: str
    """A taught label, or ``UNKNOWN``."""
    probabilities: Mapping[str, float] = field(hash=False)
    """Probability of each taught label and of ``UNKNOWN``; they sum to 1."""
    n_grasps: int
    """Number of grasps."""
    kept: bool = False
    """Whether the part is still in the grip; the host releases it."""
    shape: FeltShape | None = None
    """Shape and size, also of an untaught object; None if the pads do not show them, or if
    ``recognition.shape`` is off in the config."""
    n_ended_early: int = 0
    """Number of grasps whose ramp ended early because the answer was sure enough."""
    drift: "DriftGrid | None" = None
    """The sensor drift that it assumes; None if drift is not followed."""
    remark: str = ""
    """Message for the operator: the sensors have drifted (once), or the part is too small or too
    soft for the force of the ramp. Empty otherwise."""
    job: int = 0
    """Number of the job that found it."""

    @property
    def probability(self) -> float:
        """Probability of the label."""
        return self.probabilities[self.label]

    @property
    def size_mm(self) -> float:
        """Size in mm; 0 if it was not measured."""
        return 0.0 if self.shape is None else self.shape.size_mm

    @property
    def unknown(self) -> float:
        """Probability that the object was never taught."""
        return self.probabilities[UNKNOWN]

    @classmethod
    def of(cls, found: "Identification") -> Self:
        """Return the answer of an identification."""
        shorts = (record.outcome.short for record in found.records)
        return cls(
            label=found.label,
            probabilities=found.probabilities,
            n_grasps=len(found.records),
            shape=None if found.shape is None else FeltShape.of(found.shape),
            n_ended_early=sum(record.early is not None for record in found.records),
            drift=found.drift,
            remark=found.remark or next(filter(None, shorts), ""),
            kept=found.kept,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class HostStatus(CellStatus):
    """States of cell and grip, live values and the last answer, for a host."""

    live: "LiveValues" = field(compare=False)
    """Present force, opening, temperature and taxels."""
    recording_fault: str = ""
    """Why the recording has stopped; empty while it is written or without a recording."""
    last_answer: Answer | None
    """Answer of the last identification, also after other jobs. None from the start of the next
    identification or sort until an identification succeeds."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """Result of a check of the part in the grip: whether it is still the kept one."""

    held: bool
    """Whether both pads are loaded."""
    same: bool | None
    """Whether opening and footprint on the pads are unchanged since it was kept; None if nothing is
    held."""
    force_n: float
    """Grip force in N."""
    opening_mm: float
    """Opening between the pads in mm."""
    reasons: tuple[str, ...] = ()
    """Differences as text with value and limit; empty without any."""

    @classmethod
    def of(cls, check: "HeldCheck") -> Self:
        """Return a comparison of the held part in mm."""
        return cls(
            held=check.held,
            same=check.same,
            force_n=check.force_n,
            opening_mm=1e3 * check.opening_m,
            reasons=check.reasons,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class SortAnswer:
    """Counts of a sort."""

    n_parts: int
    """Parts that were released at a place."""
    n_missed: int
    """Turns in which no part was found."""
    n_rejected: int
    """Parts at the place of the rejects: never taught, or changed since they were named."""
    places: Mapping[str, int] = field(hash=False)
    """Parts at each place."""
