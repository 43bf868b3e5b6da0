"""Plans of grasp-then-classify sequences: an ordered list of poses and forces. Pure functions."""

import math
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Self

import numpy as np

from cell.config.sequence import SequenceConfig
from recognition.grasp import GraspCommand
from recognition.recognizer import UNKNOWN


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Pose of the object in the grip frame.

    The origin is the centre between the gripping pads. x points along the fingers to their tips,
    y across them; the fingers close along z.
    """

    x_m: float = 0.0
    """Offset of the object's centre along the fingers in m."""
    y_m: float = 0.0
    """Offset of its centre across the fingers in m."""
    rotation_rad: float = 0.0
    """Turn about the approach axis, along which the pads approach the object (z), in rad."""
    roll_rad: float = 0.0
    """Turn about the object's own long axis in rad, applied before the rotation."""

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "rotation_rad", "roll_rad"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise ValueError(f"pose has {name} = {value}; give a finite number")

    @classmethod
    def of_mm(cls, x_mm: float, y_mm: float, rotation_deg: float, roll_deg: float) -> Self:
        """Return a pose from lengths in mm and angles in degrees, the units of the config."""
        return cls(
            x_m=x_mm * 1e-3,
            y_m=y_mm * 1e-3,
            rotation_rad=math.radians(rotation_deg),
            roll_rad=math.radians(roll_deg),
        )

    def __str__(self) -> str:
        return (
            f"x {self.x_m * 1e3:+.1f} mm, y {self.y_m * 1e3:+.1f} mm, "
            f"rotation {math.degrees(self.rotation_rad):.0f} deg, "
            f"roll {math.degrees(self.roll_rad):.0f} deg"
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspStep:
    """One grasp of a plan."""

    pose: Pose
    """Pose of the object."""
    force_n: float
    """Force at the end of the ramp in N."""

    @property
    def command(self) -> GraspCommand:
        """Pose and force in the form that a grasp stores."""
        return GraspCommand(**asdict(self.pose), force_n=self.force_n)


def plan(config: SequenceConfig, n_grasps: int, *, seed: int) -> tuple[GraspStep, ...]:
    """Plan ``n_grasps`` grasps: the listed poses, or else poses and forces drawn from the ranges.

    A list starts again after its end. The same seed draws the same plan. Raises ValueError if
    ``n_grasps`` is below 1.
    """
    if n_grasps < 1:
        raise ValueError(f"a plan of {n_grasps} grasps is empty; plan at least 1")
    if config.poses:
        listed = [_step(**pose.model_dump()) for pose in config.poses]
        return tuple(listed[i % len(listed)] for i in range(n_grasps))
    rng = np.random.default_rng(seed)
    low, high = np.array(list(config.ranges.values())).T
    return tuple(_step(*row) for row in rng.uniform(low, high, size=(n_grasps, len(low))).tolist())


def _step(
    x_mm: float, y_mm: float, rotation_deg: float, roll_deg: float, force_n: float
) -> GraspStep:
    return GraspStep(pose=Pose.of_mm(x_mm, y_mm, rotation_deg, roll_deg), force_n=force_n)


class Keep(StrEnum):
    """When an identification keeps the part in the grip."""

    NEVER = "never"
    WHEN_NAMED = "when_named"
    ALWAYS = "always"

    def keeps(self, label: str) -> bool:
        """Return whether a part with this answer stays in the grip."""
        return self is Keep.ALWAYS or (self is Keep.WHEN_NAMED and label != UNKNOWN)
