"""Transmission between servos and fingers: current <-> grip force, by the newest drives.

`Mechanics` has all that a gripper knows of its own motion and force: settings, linkage, and the
drive characteristics of its servos, which each motion measures anew.
"""

from collections.abc import Mapping, Sequence
from math import hypot
from typing import Any

from gripper.dynamixel.drive import DriveCharacteristic
from gripper.errors import LimitExceeded
from gripper.mechanics.kinematics import Linkage
from gripper.settings import GripperSettings, ServoSettings
from gripper.values.state import ServoFeedback

_FRICTION_RESERVE = 1.2
"""Friction at rest over friction in motion, which a finger must overcome to move. [assumed]"""
OPENING_N = 3.0
"""Force in N beside friction that the current of an opening allows: pads may stick to a part.
[chosen]"""
MOST_FRICTION = 1.6
"""Largest friction of a gearing over its model's. A larger value has another cause. [assumed]"""
CAP_SHARE = 0.95
"""Share of the cap up to which a drive presses: its friction and torque are measured to 2 %."""
BOOST_PER_S = 2.0
"""Growth in 1/s of the factor on the current of fingers that stand still, up to
`Transmission.most_boost`. [tuned]"""


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

    def yielding_n(self, force_n: float) -> float:
        """Return the drive in N at which a force in N begins to fall; below 0 it opens."""
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

    def loaded_n(self, current_a: float) -> float:
        """Return the force in N, 0 or more, that a current reaches: inverts `loading_current_a`."""
        return max(0.0, current_a * self.n_per_a - self.friction_n)

    def pressing_n(self, current_a: float) -> float:
        """Return the largest plausible force in N that a current may press with as it rises."""
        drive = self.drive
        return (current_a - drive.least_breakaway_a) * drive.most_torque_nm_a / self.radius_m

    def pressing_current_a(self, force_n: float) -> float:
        """Return the current in A that presses with a force in N at most: the inverse."""
        drive = self.drive
        return force_n * self.radius_m / drive.most_torque_nm_a + drive.least_breakaway_a


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


class Drives:
    """The newest drive characteristic of each servo, by its ID.

    All conversions between current and force use it, with its uncertainty.
    """

    def __init__(self, newest: Mapping[int, DriveCharacteristic] | None = None) -> None:
        self.newest = dict(newest or {})
        """Those that were measured or given."""
        self.version = 0
        """Count of the changes: older values do not hold."""
        self.stiction = 1.5
        """Friction at rest over that in motion, as the pushes of the force law have shown it. At
        first that of an XM430, 1.3 to 1.8. [log]"""

    def of(self, servo: ServoSettings) -> DriveCharacteristic:
        """Return the drive characteristic of a servo; before a measurement that of its settings."""
        return self.newest.get(servo.servo_id, servo.drive)

    def put(self, servo_id: int, drive: DriveCharacteristic) -> None:
        """Replace that of a servo."""
        self.newest[servo_id] = drive
        self.version += 1


class Mechanics:
    """Mechanics of one gripper: its settings, its linkage, and its drives as they are known now.

    Parameters
    ----------
    settings, linkage
        Of the gripper. Raises LimitExceeded where their numbers of servos differ.
    drives
        The drives; by default none was measured.
    """

    def __init__(
        self, settings: GripperSettings, linkage: Linkage, drives: Drives | None = None
    ) -> None:
        if linkage.n_servos != len(settings.servos):
            raise LimitExceeded(
                f"the linkage is driven by {linkage.n_servos} servos, the settings name "
                f"{len(settings.servos)}"
            )
        self.settings, self.linkage = settings, linkage
        self.drives = drives or Drives()
        """Newest characteristics; mechanics made of these share them."""
        self.last_impact: tuple[object, Any] | None = None
        """The last impact limit, with what it was computed of; see `gripper.mechanics.impact`."""
        self._last: tuple[object, tuple[Transmission, ...]] | None = None

    def with_settings(self, settings: GripperSettings) -> "Mechanics":
        """Return the same mechanics with other settings."""
        return Mechanics(settings, self.linkage, self.drives)

    def transmissions(self, angles_rad: Sequence[float]) -> tuple[Transmission, ...]:
        """Return the transmission of each servo at its angle.

        A period of the loop asks for those of its feedback several times: the last ones are kept.
        """
        key = (self.drives.version, tuple(angles_rad))
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        radius_m, drive = self.linkage.effective_radius_m, self.drives.of
        paths = tuple(
            Transmission(drive(servo), radius_m(angle_rad))
            for servo, angle_rad in zip(self.settings.servos, angles_rad, strict=True)
        )
        self._last = key, paths
        return paths

    def end_transmissions(self) -> list[Transmission]:
        """Return the transmissions of all servos at both ends of the way; one is the worst."""
        ends_m = (self.settings.aperture_min_m, self.settings.aperture_open_m)
        return [
            path for end_m in ends_m for path in self.transmissions(self.linkage.angles_rad(end_m))
        ]

    @property
    def sure_force_n(self) -> float:
        """Force in N that each drive reaches at any opening, as strong as the cap lets it press."""
        cap_n = CAP_SHARE * self.settings.force_max_n
        paths = self.end_transmissions()
        return min(path.loaded_n(path.pressing_current_a(cap_n)) for path in paths)

    def opening_steps_m(self) -> list[float]:
        """Return the change of the opening in m by one count of each servo, at closed fingers."""
        reach_m = self.linkage.opening_per_rad_m(self.linkage.angles_rad(0.0)[0])
        return [reach_m * servo.servo_model.rad_per_pulse for servo in self.settings.servos]

    def loaded_n(self, paths: Sequence[Transmission]) -> float:
        """Return the force in N, 0 or more, up to which the whole current drives all fingers."""
        # Slightly less than the whole current, because of rounding.
        current_a = (1.0 - 1e-9) * self.settings.current_max_a
        return min(path.loaded_n(current_a) for path in paths)

    def motion_currents_a(self, paths: Sequence[Transmission], force_n: float) -> list[float]:
        """Return the current in A that moves each finger freely and presses with ``force_n`` N.

        Friction is included, with a reserve for breakaway up to the cap of the current. Raises
        LimitExceeded when the cap is too low for the friction.
        """
        most_a = self.settings.current_max_a
        least_a = max(path.loading_current_a(force_n) for path in paths)
        if least_a > most_a:
            raise LimitExceeded(
                f"moving the fingers takes {least_a:.3f} A, current_max_a is {most_a} A: write at "
                "least that where servo and part bear it, or take friction out of the linkage"
            )
        currents_a = [
            force_n / path.n_per_a + _FRICTION_RESERVE * path.drive.breakaway_a for path in paths
        ]
        return [min(current_a, most_a) for current_a in currents_a]
