"""Linkage between servos and fingers: angle <-> aperture, and torque for a grip force.

Angles are counted from the zero of each servo and grow while the gripper opens. Grip force is the
normal force on one finger; in equilibrium both fingers carry the same force.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from math import asin, cos, pi, sin

from gripper.errors import LimitExceeded
from gripper.settings import check_settings, setting


@dataclass(frozen=True, slots=True, kw_only=True)
class Linkage(ABC):
    """Mechanics between the servos and two fingers, each the mirror image of the other."""

    offset_m: float = setting(0.0)
    """Half opening at angle 0 in m."""
    n_servos: int = setting(2, low=1, high=2)
    """1 where one servo drives both fingers, 2 where each finger has its own."""
    one_finger: bool = False
    """True for one finger with a servo of its own; its mirror image counts for the opening only."""

    def __post_init__(self) -> None:
        check_settings(self)

    @abstractmethod
    def _travel_m(self, angle_rad: float) -> float:
        """Return the half opening in m, without the offset."""

    @abstractmethod
    def _angle_rad(self, travel_m: float) -> float:
        """Return the angle at such a travel; LimitExceeded out of reach."""

    @abstractmethod
    def _travel_per_rad_m(self, angle_rad: float) -> float:
        """Return the growth of the travel in m for one rad."""

    def aperture_m(self, angles_rad: Sequence[float]) -> float:
        """Return the opening between both pads in m for one angle of each servo."""
        if len(angles_rad) != self.n_servos:
            raise LimitExceeded(
                f"got {len(angles_rad)} angles for a linkage with {self.n_servos} servos"
            )
        halves_m = [self._travel_m(angle_rad) + self.offset_m for angle_rad in angles_rad]
        return sum(halves_m) * (2.0 / self.n_servos)

    def angles_rad(self, aperture_m: float) -> tuple[float, ...]:
        """Return the angle of each servo for a centred opening; LimitExceeded out of reach."""
        return (self._angle_rad(0.5 * aperture_m - self.offset_m),) * self.n_servos

    def opening_per_rad_m(self, angle_rad: float) -> float:
        """Return the part of the aperture in m that one servo opens for one rad."""
        return self._travel_per_rad_m(angle_rad) * (2.0 / self.n_servos)

    def effective_radius_m(self, angle_rad: float) -> float:
        """Return the torque of a servo for a grip force of 1 N, in N m / N.

        By virtual work that of each finger which it drives.
        """
        fingers = 1.0 if self.one_finger else 2.0 / self.n_servos
        return self._travel_per_rad_m(angle_rad) * fingers

    def of_one_finger(self) -> "Linkage":
        """Return the linkage of one finger, driven by a servo of its own."""
        return replace(self, n_servos=1, one_finger=True)


@dataclass(frozen=True, slots=True, kw_only=True)
class ParallelLinkage(Linkage):
    """Rotary fingers on a parallelogram, so that the pads stay parallel.

    Half opening = link_m * sin(angle) + offset_m.
    """

    link_m: float = setting(MISSING, above=0.0)
    """Length of the parallelogram's links in m."""

    def __str__(self) -> str:
        return f"link_mm {self.link_m * 1e3:g}, offset_mm {self.offset_m * 1e3:g}"

    def _travel_m(self, angle_rad: float) -> float:
        return self.link_m * sin(angle_rad)

    def _angle_rad(self, travel_m: float) -> float:
        if not -self.link_m < travel_m < self.link_m:
            raise LimitExceeded(
                f"an opening of {2.0 * (travel_m + self.offset_m):g} m is out of reach of links of "
                f"{self.link_m} m with an offset of {self.offset_m} m"
            )
        return asin(travel_m / self.link_m)

    def _travel_per_rad_m(self, angle_rad: float) -> float:
        if not -pi / 2.0 < angle_rad < pi / 2.0:
            raise LimitExceeded(
                f"the link stands at {angle_rad} rad, beyond its dead centre at 1.571 rad: "
                f"check gripper.servos[].zero_pulse and direction"
            )
        return self.link_m * cos(angle_rad)


_OVERRUN_RAD = 0.3
"""Angle in rad of a pinion beyond its widest opening: a finger may overrun it. [chosen]"""


@dataclass(frozen=True, slots=True, kw_only=True)
class RackPinion(Linkage):
    """Straight fingers on racks: half opening = pinion_radius_m * angle + offset_m."""

    pinion_radius_m: float = setting(MISSING, above=0.0)
    """Pitch radius of the pinion in m."""
    n_servos: int = setting(1, low=1, high=2)
    """1 (one pinion between two racks) or 2."""

    def __str__(self) -> str:
        radius_mm = self.pinion_radius_m * 1e3
        return f"pinion_radius_mm {radius_mm:g}, offset_mm {self.offset_m * 1e3:g}"

    def _travel_m(self, angle_rad: float) -> float:
        return self.pinion_radius_m * angle_rad

    def _angle_rad(self, travel_m: float) -> float:
        angle_rad = travel_m / self.pinion_radius_m
        if not -0.5 * pi < angle_rad < 1.5 * pi - _OVERRUN_RAD:
            raise LimitExceeded(
                f"an opening of {2.0 * (travel_m + self.offset_m):g} m is out of reach of one turn "
                f"of a pinion of {self.pinion_radius_m} m with an offset of {self.offset_m} m"
            )
        return angle_rad

    def _travel_per_rad_m(self, angle_rad: float) -> float:
        return self.pinion_radius_m
