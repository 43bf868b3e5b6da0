"""Goals of a host's jobs, as values or as mappings, and their checks."""

from collections.abc import Mapping
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from cell.config.simulator import checked_label
from cell.errors import ConfigError


class _Goal(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)


class TeachGoal(_Goal):
    """Grasp a known object."""

    label: Annotated[str, AfterValidator(checked_label)] = Field(min_length=1, max_length=60)
    """Name of the object."""
    grasps: int = Field(default=10, ge=1, le=1000)
    """How many times it is grasped, 1 to 1000."""
    seed: int = Field(default=0, ge=0)
    """Seed of the plan of poses and forces."""


class IdentifyGoal(_Goal):
    """Grasp and classify an unknown object until its name is sure enough."""

    max_grasps: int | None = Field(default=None, ge=1, le=100)
    """Most grasps, or None for the number in the config."""
    seed: int = Field(default=1, ge=0)
    """Seed of the plan of poses and forces."""
    present: str | None = None
    """Object to place first, where the positioner can do so (simulated cell)."""


_TASKS: dict[str, TypeAdapter[TeachGoal] | TypeAdapter[IdentifyGoal]] = {
    "teach": TypeAdapter(TeachGoal),
    "identify": TypeAdapter(IdentifyGoal),
}


def checked_goal(goal: TeachGoal | IdentifyGoal | Mapping[str, Any]) -> TeachGoal | IdentifyGoal:
    """Return a goal, from a mapping with ``task`` and the fields of the goal too.

    Raises
    ------
    ConfigError
        If it is no goal, the task or a field is unknown, or a value out of range.
    """
    if isinstance(goal, TeachGoal | IdentifyGoal):
        return goal
    if not isinstance(goal, Mapping):
        raise ConfigError(
            f"goal is {goal!r:.60}; write a TeachGoal, an IdentifyGoal, or a mapping with task and "
            "the fields of these"
        )
    fields = dict(goal)
    task = fields.pop("task", None)
    if not isinstance(task, str) or task not in _TASKS:
        raise ConfigError(f"goal has task {task!r}; write one of {', '.join(_TASKS)}")
    try:
        return _TASKS[task].validate_python(fields)
    except ValidationError as error:
        complaints = "; ".join(
            f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()
        )
        raise ConfigError(f"goal {task}: {complaints}") from error
