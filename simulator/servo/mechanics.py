"""Motion of the simulated fingers: one or two servos, friction, end stops, contact forces.

Semi-implicit Euler steps with implicit contact stiffness, and Karnopp's friction: an axis at rest
stays there until the torque exceeds the stiction, so a gripper that holds a part does not creep.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from simulator.errors import SimulatorSettingsError
from simulator.servo.motor import ServoMotor

FINGER_INERTIA_KG_M2 = 2e-4
"""Inertia of one finger and its link about the servo's axis in kg m²; an assumption."""
HAND_SPEED_M_S = 0.05
"""Speed in m/s of a finger moved by hand; an assumption."""
HAND_FORCE_N = 0.3
"""Force in N on the pad at which a person stops closing a finger: both pads touch lightly."""
LARGEST_LINK_ANGLE_RAD = math.radians(80.0)
"""Angle of a parallelogram's link at its open end stop, short of its singular position at 90°."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ParallelogramLinkage:
    """A finger on a parallelogram: the pad stays parallel, half opening = L sin(angle) + offset."""

    kind: ClassVar[str] = "parallel links"
    link_m: float = 0.06
    """Length L of the parallelogram's link in m."""
    offset_m: float = 0.0
    """Half opening in m at the angle 0."""
    open_stop_rad: float = LARGEST_LINK_ANGLE_RAD
    """Angle in rad of the open end stop."""

    @property
    def half_opening_max_m(self) -> float:
        """Half opening in m with the link at its largest angle."""
        return self.half_opening_m(self.open_stop_rad)

    @property
    def half_opening_min_m(self) -> float:
        """Half opening in m with the link at its least angle."""
        return self.offset_m - self.link_m * math.sin(LARGEST_LINK_ANGLE_RAD)

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
    """A finger on a rack: half opening = pinion radius x angle + offset."""

    kind: ClassVar[str] = "racks with a pinion"
    pinion_radius_m: float = 0.01
    """Radius of the pinion's pitch circle in m."""
    offset_m: float = 0.0
    """Half opening in m at the angle 0."""
    travel_m: float = 0.05
    """Largest half opening in m."""

    @property
    def half_opening_max_m(self) -> float:
        """Largest half opening in m."""
        return self.travel_m

    @property
    def half_opening_min_m(self) -> float:
        """Least half opening in m."""
        return -self.travel_m

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


FingerLinkage = ParallelogramLinkage | RackLinkage
"""Geometry from a servo angle to the half opening of its fingers: the distance of a pad from the
centre plane in m, which grows with the linkage angle. The formulas are deliberately separate from
those of the driver: an error in one of them shows as a disagreement."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoMount:
    """Mounting of a servo in the gripper: direction and zero."""

    direction: int = 1
    """+1 when the fingers open with a growing position, -1 when they close."""
    zero_raw: int = 2048
    """Raw position at the linkage angle 0."""


def velocity_after(
    velocity: float,
    push: float,
    friction: float,
    inertia: float,
    damping: float,
    *,
    breakaway: float,
) -> float:
    """Return the velocity in rad/s after a step, of a body under Karnopp's friction.

    Torques times the step's length in N.m s, damping in the unit of the inertia. ``breakaway`` is
    the friction at rest over that in motion.
    """
    if velocity == 0.0:
        if abs(push) <= breakaway * friction:
            return 0.0
        push -= math.copysign(friction, push)
    else:
        push -= math.copysign(friction, velocity)
    new = (inertia * velocity + push) / (inertia + damping)
    return 0.0 if new * velocity < 0.0 else new


class FingerMechanics:
    """Two fingers: one servo drives both, or each finger has its own servo.

    Parameters
    ----------
    motors
        One or two motors; their angles are set to the start aperture.
    half_opening_min_m
        Closed end stop in m; below 0 a finger may pass the middle until the other finger stops it.
    """

    def __init__(
        self,
        motors: Sequence[ServoMotor],
        mounts: Sequence[ServoMount],
        linkage: FingerLinkage,
        *,
        aperture_m: float,
        half_opening_min_m: float = 0.0,
    ) -> None:
        self.motors = tuple(motors)
        self._single = len(motors) == 1
        self._linkage = linkage
        self._axes = tuple(
            (mount.direction, mount.zero_raw * motor.model.rad_per_pulse)
            for mount, motor in zip(mounts, motors, strict=True)
        )
        self._lower_m = half_opening_min_m
        self._lower_rad = linkage.angle_rad(half_opening_min_m)
        self._upper_rad = linkage.angle_rad(linkage.half_opening_max_m)
        self._hands_rad: dict[int, float] = {}
        self.drive_to(aperture_m)

    @property
    def finger_position_m(self) -> tuple[float, float]:
        """Half openings of finger 0 and finger 1 from the centre plane in m."""
        near_m = self._position_m(0)
        return near_m, near_m if self._single else self._position_m(1)

    def _position_m(self, axis: int) -> float:
        direction, zero_rad = self._axes[axis]
        half_m = self._linkage.half_opening_m(direction * (self.motors[axis].angle_rad - zero_rad))
        return half_m if half_m > self._lower_m else self._lower_m

    @property
    def aperture_m(self) -> float:
        """Distance between the two pads in m."""
        first, second = self.finger_position_m
        return first + second

    def drive_to(self, aperture_m: float) -> None:
        """Put both fingers at rest at an aperture in m; below 0 the pads press on each other."""
        theta = self._linkage.angle_rad(0.5 * aperture_m)
        for motor, (direction, zero_rad) in zip(self.motors, self._axes, strict=True):
            motor.place(zero_rad + direction * theta)

    def move_by_hand(self, axis: int, half_opening_m: float) -> None:
        """Let a person move a finger without torque to a half opening in m.

        The finger stops at a contact (`HAND_FORCE_N`) and at its end stops; then the friction of
        the gearing holds it. A motor with torque is not moved.

        Parameters
        ----------
        axis
            Index of the servo; a single servo moves both fingers.
        half_opening_m
            Distance of the pad from the centre plane in m; beyond an end stop: up to the stop.
        """
        lowest_m = self._linkage.half_opening_m(self._lower_rad)
        reached_m = min(max(half_opening_m, lowest_m), self._linkage.half_opening_max_m)
        self._hands_rad[axis] = self._linkage.angle_rad(reached_m)

    @property
    def moved_by_hand(self) -> bool:
        """Whether a person still moves a finger."""
        return bool(self._hands_rad)

    def remount(self, axis: int, *, turned: bool = False, off_rad: float = 0.0) -> None:
        """Mount a servo differently; its finger stays where it is.

        Parameters
        ----------
        axis
            Index of the servo.
        turned
            Whether to reverse its direction.
        off_rad
            Offset of its position towards open in rad.
        """
        motor = self.motors[axis]
        direction, zero_rad = self._axes[axis]
        theta = direction * (motor.angle_rad - zero_rad)
        zero_rad += direction * off_rad
        direction = -direction if turned else direction
        axes = list(self._axes)
        axes[axis] = (direction, zero_rad)
        self._axes = tuple(axes)
        motor.place(zero_rad + direction * theta)

    def step(
        self,
        dt_s: float,
        contact_force_n: tuple[float, float],
        contact_stiffness_n_m: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Advance the fingers by ``dt_s`` s.

        Parameters
        ----------
        dt_s
            Time step in s, at most 1 ms: stable for the stiffest foam against the lightest rotor.
        contact_force_n
            Force on each pad in N at the present position, positive when it pushes the finger open.
        contact_stiffness_n_m
            Decrease of that force per opening of the finger in N/m, at least 0.
        """
        force_n, stiffness_n_m = contact_force_n, contact_stiffness_n_m
        if self._single:
            self._move(0, dt_s, force_n[0] + force_n[1], stiffness_n_m[0] + stiffness_n_m[1])
        else:
            self._move(0, dt_s, force_n[0], stiffness_n_m[0])
            self._move(1, dt_s, force_n[1], stiffness_n_m[1])

    def _move(self, axis: int, dt_s: float, force_n: float, stiffness_n_m: float) -> None:
        motor = self.motors[axis]
        direction, zero_rad = self._axes[axis]
        theta = direction * (motor.angle_rad - zero_rad)
        slope = direction * self._linkage.slope_m_rad(theta)
        driving_nm, load_nm = motor.torque_nm(dt_s), slope * force_n
        if axis in self._hands_rad:
            self._move_by_hand(axis, dt_s, theta, force_n)
            return
        friction_nm = motor.friction_nm(driving_nm, load_nm)
        spring = dt_s * dt_s * slope * slope * stiffness_n_m
        new = velocity_after(
            motor.velocity_rad_s,
            dt_s * (driving_nm + load_nm),
            dt_s * friction_nm,
            motor.inertia_kg_m2 + FINGER_INERTIA_KG_M2,
            dt_s * motor.viscous_nm_s + spring,
            breakaway=motor.breakaway,
        )
        motor.velocity_rad_s = new
        if new == 0.0:
            return
        theta += direction * new * dt_s
        if theta < self._lower_rad:
            theta, new = self._lower_rad, 0.0
        elif theta > self._upper_rad:
            theta, new = self._upper_rad, 0.0
        motor.velocity_rad_s = new
        motor.angle_rad = zero_rad + direction * theta

    def _move_by_hand(self, axis: int, dt_s: float, theta: float, force_n: float) -> None:
        motor, (direction, zero_rad) = self.motors[axis], self._axes[axis]
        left_rad = self._hands_rad[axis] - theta
        longest_rad = HAND_SPEED_M_S * dt_s / abs(self._linkage.slope_m_rad(theta))
        touching = left_rad < 0.0 and force_n >= HAND_FORCE_N * (3 - len(self.motors))
        if touching or motor.command.mode is not None or abs(left_rad) < longest_rad:
            del self._hands_rad[axis]
            motor.velocity_rad_s = 0.0
            return
        motor.velocity_rad_s = direction * math.copysign(longest_rad, left_rad) / dt_s
        motor.angle_rad = zero_rad + direction * (theta + math.copysign(longest_rad, left_rad))
