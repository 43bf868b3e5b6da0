"""How a grasp was asked for: pose of the object, and the force at the end of the ramp."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

COLUMNS = ("x_m", "y_m", "rotation_rad", "roll_rad", "force_n")
"""What the numbers of a placing mean, in their order."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Placing:
    """Pose and force that were asked for in one grasp; the record of the pose reached is elsewhere.

    Who chooses a grasp can only ask: what comes of it is part of what the grasp tells.

    Attributes
    ----------
    x_m, y_m
        Offset of the object along the fingers and across them in m.
    rotation_rad, roll_rad
        Turn about the closing axis, and before that about the object's own axis, in rad.
    force_n
        Force at the end of the ramp in N.

    Raises
    ------
    ValueError
        A number is not finite.
    """

    x_m: float
    y_m: float
    rotation_rad: float
    roll_rad: float
    force_n: float

    def __post_init__(self) -> None:
        for name in COLUMNS:
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} of a placing is {getattr(self, name)}, must be finite")

    @property
    def values(self) -> tuple[float, ...]:
        """The numbers in the order of `COLUMNS`."""
        return (self.x_m, self.y_m, self.rotation_rad, self.roll_rad, self.force_n)

    @classmethod
    def of(cls, values: Sequence[float]) -> Self:
        """Rebuild from `values`. Raises ValueError where they are not five finite numbers."""
        return cls(**dict(zip(COLUMNS, map(float, values), strict=True)))
