"""Linkage between servos and fingers: angle <-> aperture, current <-> grip force.

Angles are counted from the zero of each servo and grow while the gripper opens. Grip force is the
normal force on one finger; in equilibrium both fingers carry the same force.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from math import asin, cos, hypot, pi, sin

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import LimitExceeded
from gripper.settings import GripperSettings, check_settings, setting
from gripper.values.state import ServoFeedback

_FRICTION_RESERVE = 1.2
"""Friction at rest over friction in motion, which a finger must overcome to move. [assumed]"""
MOST_FRICTION = 1.6
"""Largest friction of a gearing over its model's. A larger value has another cause. [assumed]"""
BOOST_PER_S = 2.0
"""Growth in 1/s of the factor on the current of fingers that stand still, up to
`Transmission.most_boost`. [tuned]"""


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
        if not -0.5 * pi < angle_rad < 1.5 * pi:
            raise LimitExceeded(
                f"an opening of {2.0 * (travel_m + self.offset_m):g} m is out of reach of one turn "
                f"of a pinion of {self.pinion_radius_m} m with an offset of {self.offset_m} m"
            )
        return angle_rad

    def _travel_per_rad_m(self, angle_rad: float) -> float:
        return self.pinion_radius_m


class Transmission:
    """Relation of servo current and grip force at one position, with the friction of the gearing.

    The torque at rest may lie anywhere in a band: the motor works against friction while the force
    rises, and friction helps while it falls. Forces of a drive are those that its current would
    make of a rising load without friction.

    Parameters
    ----------
    drive
        Drive of the servo.
    radius_m
        Torque of the servo for a grip force of 1 N, in N m / N.
    """

    def __init__(self, drive: DriveCharacteristic, radius_m: float) -> None:
        self.drive = drive
        self.radius_m = radius_m
        self.n_per_a = 1.0 / (drive.rising_a_nm * radius_m)
        """Driving force in N for 1 A."""
        self.friction_n = drive.breakaway_a * self.n_per_a
        """Half the width of the friction band without a load, as grip force in N."""
        self._passive_n = drive.yielding_share * drive.breakaway_a / (drive.falling_a_nm * radius_m)
        """Largest force in N that the gearing holds without a current."""

    @property
    def most_boost(self) -> float:
        """Largest factor on the current that moves a finger: its friction at rest may be more."""
        return max(MOST_FRICTION, self.drive.most_breakaway_a / self.drive.breakaway_a)

    def held_n(self, drive_n: float) -> float:
        """Return the largest force in N that a drive in N holds; below 0 if it opens the finger."""
        if drive_n >= 0.0:
            return self._passive_n + drive_n * self.drive.rising_a_nm / self.drive.falling_a_nm
        return self._passive_n * (1.0 + drive_n / self.friction_n)

    def yielding_n(self, force_n: float) -> float:
        """Return the drive in N at which a force in N begins to fall: the inverse of `held_n`."""
        above_n = force_n - self._passive_n
        if above_n >= 0.0:
            return above_n * self.drive.falling_a_nm / self.drive.rising_a_nm
        return self.friction_n * above_n / self._passive_n

    def force_sd_n(self, force_n: float) -> float:
        """Return the standard deviation in N of a grip force by the current alone."""
        load_n = abs(force_n) + self.friction_n
        return hypot(self.drive.load_sd * load_n, self.drive.friction_sd * self.friction_n)

    def loading_current_a(self, force_n: float) -> float:
        """Return the current in A that drives the force up to ``force_n``."""
        return force_n / self.n_per_a + self.drive.breakaway_a

    def force_band_n(self, current_a: float) -> tuple[float, float]:
        """Return the least and the largest grip force in N that a current can hold."""
        centre_n, friction_n = current_a * self.n_per_a, self.friction_n
        return max(0.0, centre_n - friction_n), max(0.0, self.held_n(centre_n))

    def pressing_n(self, current_a: float) -> float:
        """Return the largest plausible force in N that a current may press with as it rises."""
        drive = self.drive
        return (current_a - drive.least_breakaway_a) * drive.most_torque_nm_a / self.radius_m

    def pressing_current_a(self, force_n: float) -> float:
        """Return the current in A that presses with a force in N at most: the inverse."""
        drive = self.drive
        return force_n * self.radius_m / drive.most_torque_nm_a + drive.least_breakaway_a


def transmissions(
    settings: GripperSettings, linkage: Linkage, angles_rad: Sequence[float]
) -> tuple[Transmission, ...]:
    """Return the transmission of each servo at its angle.

    A period of the loop asks for those of its feedback several times: the last ones are kept.
    """
    drives = settings.drives
    key = (drives.version, settings.servos, linkage, tuple(angles_rad))
    cached: tuple[object, tuple[Transmission, ...]] | None = drives.cache.get("transmissions")
    if cached is not None and cached[0] == key:
        return cached[1]
    paths = tuple(
        Transmission(drives.of(servo.servo_id, servo.drive), linkage.effective_radius_m(angle_rad))
        for servo, angle_rad in zip(settings.servos, angles_rad, strict=True)
    )
    drives.cache["transmissions"] = key, paths
    return paths


def end_transmissions(settings: GripperSettings, linkage: Linkage) -> list[Transmission]:
    """Return the transmissions of all servos at both ends of the way; one of them is the worst."""
    return [
        path
        for aperture_m in (settings.aperture_min_m, settings.aperture_open_m)
        for path in transmissions(settings, linkage, linkage.angles_rad(aperture_m))
    ]


def opening_steps_m(settings: GripperSettings, linkage: Linkage) -> list[float]:
    """Return for each servo the change of the opening in m by one count, with closed fingers."""
    return [
        linkage.opening_per_rad_m(closed_rad) * servo.servo_model.rad_per_pulse
        for closed_rad, servo in zip(linkage.angles_rad(0.0), settings.servos, strict=True)
    ]


def mean_friction_n(paths: Sequence[Transmission]) -> float:
    """Return half the width of the friction band in N, the mean of the servos."""
    return sum([path.friction_n for path in paths]) / len(paths)


def mean_yielding_n(paths: Sequence[Transmission], force_n: float) -> float:
    """Return the drive in N at which a force in N begins to fall, the mean of the servos."""
    return sum([path.yielding_n(force_n) for path in paths]) / len(paths)


def driving_n(state: ServoFeedback, paths: Sequence[Transmission]) -> float:
    """Return the driving force in N of the measured currents, without friction."""
    drive_n = 0.0
    for servo, path in zip(state.servos, paths, strict=True):
        drive_n -= servo.current_a * path.n_per_a
    return drive_n / len(paths)


def motion_currents_a(
    settings: GripperSettings, paths: Sequence[Transmission], force_n: float
) -> list[float]:
    """Return the current in A that moves each finger freely and presses with at most ``force_n``.

    Friction is included, with a reserve for breakaway up to the cap of the current. Raises
    LimitExceeded when the cap is too low for the friction.
    """
    least_a = max(path.loading_current_a(force_n) for path in paths)
    if least_a > settings.current_max_a:
        raise LimitExceeded(
            f"moving the fingers takes {least_a:.3f} A, current_max_a is "
            f"{settings.current_max_a} A: write at least that where servo and part bear it, or "
            "take friction out of the linkage"
        )
    currents_a = [
        force_n / path.n_per_a + _FRICTION_RESERVE * path.drive.breakaway_a for path in paths
    ]
    return [min(current_a, settings.current_max_a) for current_a in currents_a]
