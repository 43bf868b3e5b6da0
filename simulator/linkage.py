"""How the angle of a simulated servo becomes the half opening of a finger.

Own formulas of the simulator, on purpose not shared with the driver: an error in one of the two
shows as a disagreement. The half opening is the distance of a finger's pad from the centre plane in
m; the linkage angle grows with it.
"""

import math
from dataclasses import dataclass
from typing import Protocol

from simulator.errors import SimulatorSettingsError


class FingerLinkage(Protocol):
    """Geometry between one servo angle and the half opening of the fingers that it drives."""

    @property
    def half_opening_max_m(self) -> float:
        """Largest half opening in m that the geometry allows."""
        ...

    def half_opening_m(self, angle_rad: float) -> float:
        """Return the half opening in m at a linkage angle in rad."""
        ...

    def slope_m_rad(self, angle_rad: float) -> float:
        """Return d(half opening)/d(angle) in m/rad, which turns force into torque."""
        ...

    def angle_rad(self, half_opening_m: float) -> float:
        """Return the linkage angle in rad; SimulatorSettingsError when out of reach."""
        ...


def _positive(name: str, value: float) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise SimulatorSettingsError(f"{name} is a positive finite length, got {value}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ParallelogramLinkage:
    """A finger on a parallelogram: the pad stays parallel, half opening = L sin(angle) + offset.

    Attributes
    ----------
    link_m
        Length L of the parallelogram's link in m.
    offset_m
        Half opening in m at the angle 0.
    """

    link_m: float = 0.06
    offset_m: float = 0.0

    def __post_init__(self) -> None:
        _positive("link_m", self.link_m)

    @property
    def half_opening_max_m(self) -> float:
        """Half opening in m with the link at 80 degrees, short of its singular position."""
        return self.link_m * math.sin(math.radians(80.0)) + self.offset_m

    def half_opening_m(self, angle_rad: float) -> float:
        """Return the half opening in m at a linkage angle in rad."""
        return self.link_m * math.sin(angle_rad) + self.offset_m

    def slope_m_rad(self, angle_rad: float) -> float:
        """Return d(half opening)/d(angle) in m/rad."""
        return self.link_m * math.cos(angle_rad)

    def angle_rad(self, half_opening_m: float) -> float:
        """Return the linkage angle in rad; SimulatorSettingsError when out of reach."""
        ratio = (half_opening_m - self.offset_m) / self.link_m
        if not -1.0 <= ratio <= 1.0:
            raise SimulatorSettingsError(
                f"half opening {half_opening_m} m is out of reach of a link of {self.link_m} m "
                f"with an offset of {self.offset_m} m"
            )
        return math.asin(ratio)


@dataclass(frozen=True, slots=True, kw_only=True)
class RackLinkage:
    """A finger on a rack: half opening = pinion radius x angle + offset.

    Attributes
    ----------
    pinion_radius_m
        Radius of the pinion's pitch circle in m.
    offset_m
        Half opening in m at the angle 0.
    travel_m
        Largest half opening in m.
    """

    pinion_radius_m: float = 0.01
    offset_m: float = 0.0
    travel_m: float = 0.05

    def __post_init__(self) -> None:
        _positive("pinion_radius_m", self.pinion_radius_m)
        _positive("travel_m", self.travel_m)

    @property
    def half_opening_max_m(self) -> float:
        """Largest half opening in m."""
        return self.travel_m

    def half_opening_m(self, angle_rad: float) -> float:
        """Return the half opening in m at a pinion angle in rad."""
        return self.pinion_radius_m * angle_rad + self.offset_m

    def slope_m_rad(self, angle_rad: float) -> float:
        """Return the pinion radius in m/rad, the same at every angle."""
        return self.pinion_radius_m

    def angle_rad(self, half_opening_m: float) -> float:
        """Return the pinion angle in rad; SimulatorSettingsError when beyond the travel."""
        if not -self.travel_m <= half_opening_m <= self.travel_m:
            raise SimulatorSettingsError(
                f"half opening {half_opening_m} m is beyond the rack's travel of {self.travel_m} m"
            )
        return (half_opening_m - self.offset_m) / self.pinion_radius_m
