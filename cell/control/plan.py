"""Plans of grasp-then-classify sequences: an ordered list of poses and forces. Pure functions."""

import itertools
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


def _levels(low: float, high: float, count: int) -> list[float]:
    """Spread ``count`` values evenly over a range; a single value is its middle."""
    if count == 1:
        return [0.5 * (low + high)]
    return [low + (high - low) * i / (count - 1) for i in range(count)]


def plan_grid(config: SequenceConfig, n_grasps: int) -> tuple[GraspStep, ...]:
    """Walk a grid over position, rotation, roll and force.

    The grid has ``grid_points`` values on each axis with a range. Its strides are coprime to its
    size, so that already the first grasps differ in all axes. It starts again when ``n_grasps``
    exceeds its size.
    """
    ranges = config.ranges.values()
    axes = [_levels(low, high, config.grid_points if high > low else 1) for low, high in ranges]
    grid = list(itertools.product(*axes))
    stride = max(1, int(len(grid) * 0.618))
    while math.gcd(stride, len(grid)) != 1:
        stride += 1
    return tuple(_step(*grid[(i * stride) % len(grid)]) for i in range(n_grasps))


def plan_random(config: SequenceConfig, n_grasps: int, *, seed: int) -> tuple[GraspStep, ...]:
    """Draw poses and forces evenly from their ranges; the same seed gives the same plan."""
    rng = np.random.default_rng(seed)
    low, high = np.array(list(config.ranges.values())).T
    return tuple(_step(*row) for row in rng.uniform(low, high, size=(n_grasps, len(low))).tolist())


def plan_list(config: SequenceConfig, n_grasps: int) -> tuple[GraspStep, ...]:
    """Take the listed poses in order; start again when ``n_grasps`` exceeds the list."""
    listed = [_step(**pose.model_dump()) for pose in config.poses]
    return tuple(listed[i % len(listed)] for i in range(n_grasps))


def plan(config: SequenceConfig, n_grasps: int, *, seed: int) -> tuple[GraspStep, ...]:
    """Plan ``n_grasps`` grasps of the config's ``kind``.

    Raises ValueError if ``n_grasps`` is below 1.
    """
    if n_grasps < 1:
        raise ValueError(f"a plan of {n_grasps} grasps is empty; plan at least 1")
    if config.kind == "grid":
        return plan_grid(config, n_grasps)
    if config.kind == "list":
        return plan_list(config, n_grasps)
    return plan_random(config, n_grasps, seed=seed)


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
