"""Config of sorting: the places of named parts."""

from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from cell.config.section import Section, refuse_repeats
from cell.config.simulator import checked_label


class PlacePoseConfig(Section):
    """Pose of a place, for a positioner with its own axes."""

    x_mm: float = Field(default=0.0, ge=-10000.0, le=10000.0)
    """Position along the fingers in mm, -10000 to 10000."""
    y_mm: float = Field(default=0.0, ge=-10000.0, le=10000.0)
    """Position across the fingers in mm, -10000 to 10000."""
    rotation_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the approach axis in degrees, -360 to 360."""
    roll_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the object's own axis in degrees, -360 to 360."""


class PlaceConfig(Section):
    """The place of one kind of part."""

    label: Annotated[str, AfterValidator(checked_label)] = Field(min_length=1, max_length=60)
    """Name of the part."""
    place: str = Field(min_length=1, max_length=60)
    """Name of its place; several parts may share one."""
    pose: PlacePoseConfig | None = None
    """Pose of the place; none: the host or a person finds it by its name."""


class SortConfig(Section):
    """Places to which a sort brings the named parts."""

    places: tuple[PlaceConfig, ...] = Field(default=(), max_length=1000)
    """Places of the taught parts; empty: each part has a place with its own name."""
    reject: str = Field(default="reject", min_length=1, max_length=60)
    """Name of the place for unknown parts, and for parts that changed on the way."""
    reject_pose: PlacePoseConfig | None = None
    """Pose of that place; none: the host or a person finds it by its name."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        refuse_repeats((entry.label for entry in self.places), "labels of sort.places")
        return self
