"""A part of an identification or sort, and the other results of jobs, as all programs read them."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ConfigDict, Field, computed_field, field_serializer

from recognition.recognizer import UNKNOWN, answer_probability

if TYPE_CHECKING:
    from recognition.drift.drift import DriftGrid
    from recognition.shape.answer import ShapeAnswer
else:  # their libraries are loaded with the first cell
    DriftGrid = ShapeAnswer = Any


class Part(BaseModel):
    """A part: its name, its measured values, and what became of it.

    ``model_dump`` gives the JSON of all programs; it leaves out what is large.
    """

    model_config = ConfigDict(frozen=True, use_attribute_docstrings=True)

    number: int = 0
    """Its number among all parts of this program, from 1; 0 if no part was found."""
    job: int = 0
    """Number of the job that found it."""
    task: str = "identify"
    """``identify`` or ``sort``."""
    time_s: float = 0.0
    """Unix time in s of its answer."""
    seconds: float = 0.0
    """Time since the previous part, or since the start of the job, in s of the cell's clock."""
    presented: str = ""
    """Label of the brought object according to host, person or simulator; empty if not given."""
    label: str = ""
    """A taught label, or ``UNKNOWN``; empty if no part was found."""
    label_id: int = 0
    """Id of the label, from 1; 0 for ``UNKNOWN``."""
    probabilities: Mapping[str, float] = Field(default_factory=dict, exclude=True)
    """Probability of each taught label and, last, of ``UNKNOWN``; they sum to 1."""
    n_grasps: int = 0
    """Number of grasps."""
    n_ended_early: int = 0
    """Number of grasps whose ramp ended early because the answer was sure enough."""
    in_grip: bool = False
    """Whether the part is still in the grip; the host releases it."""
    shape: ShapeAnswer | None = None
    """Shape and size by all grasps together, also of an untaught object; None if the pads do not
    show them, or if ``recognition.shape`` is off in the config. Its kind in JSON."""
    drift: DriftGrid | None = Field(default=None, exclude=True)
    """The sensor drift that the answer assumes; None if drift is not followed."""
    remark: str = ""
    """Message for the operator: the sensors have drifted (once), or the part is too small or too
    soft for the force of the ramp. Empty otherwise."""
    place: str | None = None
    """Place where a sort released it."""
    place_id: int = 0
    """Number of that place, from 1, in the order of `Places.names`; 0 outside of a sort."""
    changed: tuple[str, ...] = ()
    """Changes in the grip on the way to its place, for which it was rejected."""
    rejected: bool = False
    """Whether it has no name, or was released at the place of the rejects."""

    @field_serializer("shape")
    def _kind(self, shape: ShapeAnswer | None) -> str | None:
        return None if shape is None else shape.kind

    @computed_field  # type: ignore[prop-decorator]
    @property
    def probability(self) -> float:
        """Probability of the label, see `answer_probability`; 0 before the answer."""
        return answer_probability(self.label, self.probabilities) if self.probabilities else 0.0

    @computed_field  # type: ignore[prop-decorator]
    @property
    def unknown(self) -> float:
        """Probability that the object was never taught; 0 before the answer."""
        return self.probabilities.get(UNKNOWN, 0.0)

    @computed_field  # type: ignore[prop-decorator]
    @property
    def runner_up(self) -> dict[str, Any] | None:
        """The likeliest other ``label``, also ``UNKNOWN``, and its ``probability``, or None."""
        others = [(p, label) for label, p in self.probabilities.items() if label != self.label]
        return dict(zip(("probability", "label"), max(others), strict=True)) if others else None

    @computed_field  # type: ignore[prop-decorator]
    @property
    def size_mm(self) -> float:
        """Size in mm; 0 if it was not measured."""
        return 0.0 if self.shape is None else 1e3 * self.shape.size_m

    @computed_field  # type: ignore[prop-decorator]
    @property
    def interval_mm(self) -> tuple[float, float] | None:
        """The 90 % interval of the size in mm."""
        shape = self.shape
        return None if shape is None else (1e3 * shape.low_m, 1e3 * shape.high_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """Comparison of the part in the grip with the kept part."""

    held: bool
    """Whether both pads are loaded."""
    same: bool | None
    """Whether opening and footprint on the pads are unchanged since it was kept; None if nothing is
    held."""
    force_n: float
    """Grip force in N."""
    opening_m: float
    """Opening between the pads in m."""
    reasons: tuple[str, ...] = ()
    """Differences as text with value and limit; empty without any."""
