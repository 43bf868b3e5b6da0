"""Where the object is relative to the gripper: what changes between two grasps."""

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Pose:
    """Pose of the object in the grip frame.

    The origin is the centre between the gripping pads. x points along the fingers to their tips,
    y across them; the fingers close along z.

    Attributes
    ----------
    x_m, y_m
        Offset of the object's centre in the plane of the pads in m.
    rotation_rad
        Turn about the approach axis, along which the pads approach the object (z), in rad.
    roll_rad
        Turn about the object's own long axis in rad, applied before the rotation.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    rotation_rad: float = 0.0
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "rotation_rad", "roll_rad"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise ValueError(f"pose has {name} = {value}, which is not finite")

    def as_dict(self) -> dict[str, float]:
        """Return the pose as plain numbers, keys with units."""
        return {
            "x_m": self.x_m,
            "y_m": self.y_m,
            "rotation_rad": self.rotation_rad,
            "roll_rad": self.roll_rad,
        }

    def __str__(self) -> str:
        return (
            f"x {self.x_m * 1e3:+.1f} mm, y {self.y_m * 1e3:+.1f} mm, "
            f"rotation {math.degrees(self.rotation_rad):.0f} deg, "
            f"roll {math.degrees(self.roll_rad):.0f} deg"
        )
