"""Config of a sequence: force ramps, poses, stop rule."""

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, Field

from cell.config.section import Section
from gripper.force.ramp import ForceRamp

Range = tuple[float, float]


def _within(low: float, high: float) -> AfterValidator:
    """Return the check that a range rises between two numbers."""

    def checked(value: Range) -> Range:
        if not low <= value[0] <= value[1] <= high:
            raise ValueError(
                f"[{value[0]:g}, {value[1]:g}] is not [low, high] with {low:g} <= low <= high <= "
                f"{high:g}"
            )
        return value

    return AfterValidator(checked)


Offset = Annotated[Range, _within(-100.0, 100.0)]
Turn = Annotated[Range, _within(-360.0, 360.0)]


class RampConfig(Section):
    """The force grows in a straight line to its end, which is held."""

    rate_n_s: float = Field(default=20.0, ge=0.1, le=50.0)
    """Growth of the force in N/s, 0.1 to 50."""
    hold_s: float = Field(default=0.1, ge=0.0, le=60.0)
    """Time at the end in s, up to 60."""

    def to(self, force_n: float) -> ForceRamp:
        """Return the ramp that ends at ``force_n`` N."""
        return ForceRamp.linear(force_n, self.rate_n_s, self.hold_s)


class ListedPoseConfig(Section):
    """One grasp of a listed sequence."""

    x_mm: float = Field(default=0.0, ge=-100.0, le=100.0)
    """Offset along the fingers in mm, -100 to 100."""
    y_mm: float = Field(default=0.0, ge=-100.0, le=100.0)
    """Offset across the fingers in mm, -100 to 100."""
    rotation_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the approach axis in degrees, -360 to 360."""
    roll_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the object's own axis in degrees, -360 to 360."""
    force_n: float = Field(default=4.0, gt=0.0, le=50.0)
    """Force at the end of the ramp in N, up to 50."""


class SequenceConfig(Section):
    """Poses and forces of a sequence, and its stop rule."""

    x_mm: Offset = (-2.0, 2.0)
    """Range of the offset along the fingers in mm, within -100 to 100."""
    y_mm: Offset = (-2.0, 2.0)
    """Range of the offset across the fingers in mm, within -100 to 100."""
    rotation_deg: Turn = (0.0, 360.0)
    """Range of the turn about the approach axis in degrees, within -360 to 360."""
    roll_deg: Turn = (0.0, 360.0)
    """Range of the turn about the object's own axis in degrees, within -360 to 360."""
    force_n: Annotated[Range, _within(0.5, 50.0)] = (2.0, 8.0)
    """Range of the force at the end of the ramp in N, within 0.5 to 50."""
    poses: tuple[ListedPoseConfig, ...] = Field(default=(), max_length=10000)
    """Poses and forces in order; without any they are drawn from the ranges."""
    ramp: RampConfig = RampConfig()
    """Growth of the force."""
    max_grasps: int = Field(default=4, ge=1, le=100)
    """Most grasps of one identification, 1 to 100."""
    error_rate: float = Field(default=0.02, gt=0.0, lt=0.5)
    """Probability of a wrong answer below which a sequence stops early, 0 to 0.5."""
    decide_early: bool = True
    """Whether a force ramp ends as soon as the answer is sure enough; else it goes on to its force.
    Needs the opening (`recognition.use_aperture`) and, on real ports, `loop.own_process`."""
    carry_force_n: float = Field(default=4.0, ge=0.1, le=50.0)
    """Force in N on a part that is kept for the host, 0.1 to 50."""
    regrasp: Literal["fixture", "none"] = "fixture"
    """fixture: a released part stays in place, so that further grasps take it at other poses; none:
    a released part is gone, so there is one grasp, with further ramps in the same grip."""

    def with_force(self, force_n: float) -> Self:
        """Return the same poses with one force at the end of each ramp, in N."""
        poses = tuple(pose.model_copy(update={"force_n": force_n}) for pose in self.poses)
        return self.model_copy(update={"force_n": (force_n, force_n), "poses": poses})

    @property
    def ranges(self) -> dict[str, Range]:
        """Smallest and largest value of each part of a pose, and of the force, by their keys."""
        names = list(ListedPoseConfig.model_fields)
        if not self.poses:
            return {name: getattr(self, name) for name in names}
        listed = {name: [getattr(pose, name) for pose in self.poses] for name in names}
        return {name: (min(values), max(values)) for name, values in listed.items()}

    @property
    def forces_n(self) -> Range:
        """Smallest and largest force of the sequence in N."""
        return self.ranges["force_n"]
