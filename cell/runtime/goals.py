"""Goals of a host's jobs, as values or as mappings, and their checks."""

from collections.abc import Iterable, Mapping
from typing import Any, ClassVar, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from cell.errors import ConfigError
from cell.files import checked_label

TAUGHT_GRASPS = 20
"""Default number of grasps that teach an object (docs/decisions/0007)."""
FEED_MAX = 1000
"""Most objects of a simulated feed."""


class _Goal(BaseModel):
    model_config = ConfigDict(
        strict=True, extra="forbid", frozen=True, use_attribute_docstrings=True
    )
    task: ClassVar[str]
    """Its name in requests."""

    @field_validator("label", "present", "feed", check_fields=False)
    @classmethod
    def _labels(cls, value: str | tuple[str, ...] | None) -> str | tuple[str, ...] | None:
        if value is None:
            return None
        return checked_label(value) if isinstance(value, str) else tuple(map(checked_label, value))


class _PlannedGoal(_Goal):
    seed: int | None = Field(default=None, ge=0, le=2**32 - 1)
    """Seed of the plan of poses and forces, of a sort for the first part; each further part has the
    next. None: the number of the job, so that no job repeats the poses of another."""

    def plan_seed(self, job: int) -> int:
        """Return the seed of its plan in the job with this number."""
        return job if self.seed is None else self.seed


class TeachGoal(_PlannedGoal):
    """Grasp a known object."""

    task: ClassVar[str] = "teach"
    label: str = Field(min_length=1, max_length=60)
    """Name of the object."""
    grasps: int = Field(default=TAUGHT_GRASPS, ge=1, le=1000)
    """How many times it is grasped, 1 to 1000."""
    present: str | None = None
    """Object to place, if the positioner can (simulated cell). None: the object of this label, or
    the one between the fingers, which has this label from then on."""
    train: bool = True
    """Whether the model is trained at the end. False if more objects follow: then call
    `TactileCellPlugin.train` after the last one. The progress has no sizes then."""


class GaugeGoal(_PlannedGoal):
    """Grasp a taught object to measure the drift of the sensors since teaching."""

    task: ClassVar[str] = "gauge"
    label: str = Field(min_length=1, max_length=60)
    """Name of the object."""
    grasps: int = Field(default=3, ge=1, le=100)
    """How many times it is grasped, 1 to 100."""
    present: str | None = None
    """As in `TeachGoal`."""


class ZeroGoal(_Goal):
    """Close the empty fingers on each other: zero of the opening, gains of the pads, foam."""

    task: ClassVar[str] = "zero"


class IdentifyGoal(_PlannedGoal):
    """Grasp and classify an unknown object until its name is sure enough."""

    task: ClassVar[str] = "identify"
    max_grasps: int | None = Field(default=None, ge=1, le=100)
    """Most grasps, or None for the number in the config."""
    present: str | None = None
    """Object to place first, if the positioner can (simulated cell)."""
    keep: Literal["never", "when_named", "always"] = "never"
    """Whether the part stays in the grip for the host: ``never``, ``when_named`` or ``always``."""
    force_n: float | None = Field(default=None, gt=0.0, le=50.0)
    """Force at the end of each ramp in N, up to 50, or None for the forces of the plan."""
    whole_ramps: bool = False
    """Whether no ramp ends early, also against the config."""


class GripGoal(_Goal):
    """Grip a part and keep it, without a name."""

    task: ClassVar[str] = "grip"
    force_n: float | None = Field(default=None, gt=0.0, le=50.0)
    """Force at the end of the ramp in N, up to 50, or None for ``sequence.carry_force_n`` of the
    config, 4 N by default. The part is then held with the smaller of both."""
    present: str | None = None
    """Object to place between the fingers first, if the positioner can (simulated cell). Without an
    object the positioner does not move."""


class VerifyGoal(_Goal):
    """Measure whether the part in the grip is still the named or gripped one."""

    task: ClassVar[str] = "verify"


class SortGoal(_PlannedGoal):
    """Name parts one after the other and release each at its place."""

    task: ClassVar[str] = "sort"
    parts: int = Field(default=1, ge=1, le=1_000_000)
    """How many parts."""
    feed: tuple[str, ...] = Field(default=(), strict=False, max_length=FEED_MAX)
    """Objects to place, one for each part, repeated from the first, if the positioner can
    (simulated cell). Empty: there each object of the config."""
    max_grasps: int | None = Field(default=None, ge=1, le=100)
    """Most grasps of a part, or None for the number in the config."""
    force_n: float | None = Field(default=None, gt=0.0, le=50.0)
    """Force at the end of each ramp in N, up to 50, or None for the forces of the plan."""


Goal = TeachGoal | GaugeGoal | ZeroGoal | IdentifyGoal | GripGoal | VerifyGoal | SortGoal
"""Goal of a job."""

TASKS: dict[str, type[_Goal]] = {goal.task: goal for goal in get_args(Goal)}
"""Kind of goal of each task."""


def goal_schema() -> dict[str, Any]:
    """Return the JSON schema of a goal as a mapping: ``task`` and the fields of its kind."""
    kinds = []
    for task, kind in TASKS.items():
        schema = kind.model_json_schema()
        schema["properties"] = {"task": {"const": task}} | schema.get("properties", {})
        schema["required"] = ["task", *schema.get("required", ())]
        kinds.append(schema)
    return {"oneOf": kinds}


def checked_goal(goal: Goal | Mapping[str, Any]) -> Goal:
    """Return a goal, from a mapping with ``task`` and the fields of the goal too.

    Raises
    ------
    ConfigError
        If it is not a goal, the task or a field is unknown, or a value is out of range.
    """
    if isinstance(goal, Goal):
        return goal
    if not isinstance(goal, Mapping):
        raise ConfigError(
            f"goal is {goal!r:.60}; write a goal, for example IdentifyGoal, or a mapping with task "
            "and its fields"
        )
    fields = dict(goal)
    task = fields.pop("task", None)
    if not isinstance(task, str) or task not in TASKS:
        raise ConfigError(f"goal has task {task!r:.60}; write one of {', '.join(TASKS)}")
    try:
        checked: Goal = TASKS[task].model_validate(fields)  # type: ignore[assignment]
        return checked
    except ValidationError as error:
        raise ConfigError(f"goal {task}: {complaints(error.errors())}") from error


def complaints(errors: Iterable[Mapping[str, Any]]) -> str:
    """Return the errors of pydantic as text, each with its field.

    Short: Modbus shows 64 characters, and the limit must be among them.
    """
    return "; ".join(
        f"{'.'.join(map(str, error['loc']))}: "
        + error["msg"].removeprefix("Value error, ").replace("Input should", "must")
        for error in errors
    )
