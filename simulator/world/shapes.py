"""Rigid objects as two surfaces over the plane of the pads.

Frame of an object: origin at its centre, x along its long axis, z along the closing axis when
rotation and roll are zero. Two height maps over x and y describe an object: the reach of its
surface from the centre plane towards finger 0 (in -z) and towards finger 1 (in +z).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError, require_positive

_UPRIGHT = 1e-9
"""Largest part along z of the normal of an upright slab: lines along z do not cut this slab."""
_WAIST_DIAMETER_SHARE, _WAIST_LENGTH_SHARE = 0.6, 6.0 / 13.0
"""Default waist of a dumbbell over its diameter and length; the paper has no values."""

_REACH_M, _POINTS = 0.03, 241
"""Half width in m of the field in which a thickness is looked for, and points on each side."""

Heights = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Reach in m towards finger 0 and towards finger 1, -inf beside the object."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ObjectPose:
    """Pose of an object between the pads."""

    x_m: float = 0.0
    y_m: float = 0.0
    """Offset of the object's centre from the pads' centre in m: x along the finger, y across."""
    z_m: float = 0.0
    """Offset along the closing axis in m, towards finger 1; the object then floats."""
    rotation_rad: float = 0.0
    """Turn about the closing axis (the normal of the pads) in rad."""
    roll_rad: float = 0.0
    """Turn about the object's own long axis in rad."""

    def __post_init__(self) -> None:
        for name in ("x_m", "y_m", "z_m", "rotation_rad", "roll_rad"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise SimulatorSettingsError(f"pose: {name} is {value}, must be finite")

    def __add__(self, offset: "ObjectPose") -> "ObjectPose":
        """Return this pose moved and turned by another one, each coordinate by itself."""
        names = [entry.name for entry in fields(self)]
        return ObjectPose(**{name: getattr(self, name) + getattr(offset, name) for name in names})


class Shape(Protocol):
    """A rigid object between two pads."""

    @property
    def roll_step_rad(self) -> float:
        """Resting rolls between the pads: multiples of this angle in rad; 0: any roll."""

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> Heights:
        """Return the reach towards both fingers at points of the object's own frame.

        Parameters
        ----------
        x_m, y_m : arrays of one shape
            Points in the plane of the pads in m.
        roll_rad
            Turn about the object's long axis in rad.
        """


def posed_heights(
    shape: Shape, pose: ObjectPose, x_m: NDArray[np.float64], y_m: NDArray[np.float64]
) -> Heights:
    """Return the reach of a posed object towards both fingers at points of the pads' plane.

    The offset along the closing axis is left out: the object floats along it.
    """
    dx_m, dy_m = x_m - pose.x_m, y_m - pose.y_m
    c, s = math.cos(pose.rotation_rad), math.sin(pose.rotation_rad)
    return shape.heights(c * dx_m + s * dy_m, c * dy_m - s * dx_m, pose.roll_rad)


def resting_pose(shape: Shape, pose: ObjectPose) -> ObjectPose:
    """Return the resting pose of an object: rolled onto the nearest side.

    A box on an edge settles on the nearest face; a ball does not roll.
    """
    step_rad = shape.roll_step_rad
    if not step_rad:
        return pose
    return replace(pose, roll_rad=step_rad * round(pose.roll_rad / step_rad))


def thicknesses_m(shape: Shape) -> tuple[float, ...]:
    """Return the thickness along the closing axis in m on each side it rests on, to 0.1 mm."""
    x_m, y_m = np.meshgrid(*2 * [np.linspace(-_REACH_M, _REACH_M, _POINTS)])
    rolls_rad = (0.0, shape.roll_step_rad)
    sums_m = (np.max(np.add(*shape.heights(x_m, y_m, roll_rad))) for roll_rad in rolls_rad)
    return tuple(sorted({round(float(sum_m), 4) for sum_m in sums_m}))


def _inside(reach_m: NDArray[np.float64], inside: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.where(inside, reach_m, -np.inf)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Sides:
    """Sides of a shape; the length lies along its long axis, the height along the closing axis."""

    length_m: float
    width_m: float
    height_m: float

    def __post_init__(self) -> None:
        require_positive(length_m=self.length_m, width_m=self.width_m, height_m=self.height_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class Ellipsoid(_Sides):
    """An ellipsoid."""

    @property
    def roll_step_rad(self) -> float:
        """A solid of revolution rests in any roll, another one on its four sides."""
        return 0.0 if math.isclose(self.width_m, self.height_m) else 0.5 * math.pi

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> Heights:
        """Solve the quadratic in z; see `Shape.heights`."""
        c, s = math.cos(roll_rad), math.sin(roll_rad)
        across = (2.0 / self.width_m) ** 2
        along = (2.0 / self.height_m) ** 2
        a_yy = c * c * across + s * s * along
        a_zz = s * s * across + c * c * along
        a_yz = c * s * (along - across)
        rest = 1.0 - (2.0 * x_m / self.length_m) ** 2
        under_root = (a_yz * y_m) ** 2 - a_zz * (a_yy * y_m**2 - rest)
        root = np.sqrt(np.maximum(under_root, 0.0))
        inside = under_root >= 0.0
        tilt = -a_yz * y_m
        return _inside((root - tilt) / a_zz, inside), _inside((root + tilt) / a_zz, inside)


@dataclass(frozen=True, slots=True, kw_only=True)
class Revolution:
    """A solid of revolution about its long axis; it looks the same in any roll."""

    roll_step_rad: ClassVar[float] = 0.0
    length_m: float
    """Length along the axis in m."""
    radius_m: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    """Radius in m over the distance from the middle in m, elementwise, for distances up to half the
    length."""

    def __post_init__(self) -> None:
        require_positive(length_m=self.length_m)

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> Heights:
        """Follow the circles about the axis; see `Shape.heights`."""
        del roll_rad
        distance_m = np.abs(x_m)
        radius_m = self.radius_m(np.minimum(distance_m, 0.5 * self.length_m))
        under_root = radius_m**2 - y_m**2
        inside = (distance_m <= 0.5 * self.length_m) & (under_root >= 0.0)
        reach_m = _inside(np.sqrt(np.maximum(under_root, 0.0)), inside)
        return reach_m, reach_m


@dataclass(frozen=True, slots=True, kw_only=True)
class Box(_Sides):
    """A box; it rests on its four long faces."""

    roll_step_rad: ClassVar[float] = 0.5 * math.pi

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> Heights:
        """Cut lines along z with the slabs of the rolled cross-section; see `Shape.heights`."""
        low_m = np.full(np.shape(y_m), -np.inf)
        high_m = np.full(np.shape(y_m), np.inf)
        normals = (
            (math.cos(roll_rad), math.sin(roll_rad), self.width_m),
            (-math.sin(roll_rad), math.cos(roll_rad), self.height_m),
        )
        inside = np.abs(x_m) <= 0.5 * self.length_m
        for n_y, n_z, size_m in normals:
            if abs(n_z) < _UPRIGHT:
                inside = inside & (np.abs(y_m) <= 0.5 * size_m)
                continue
            ends_m = (np.array([-0.5, 0.5]) * size_m - n_y * y_m[..., np.newaxis]) / n_z
            low_m = np.maximum(low_m, ends_m.min(axis=-1))
            high_m = np.minimum(high_m, ends_m.max(axis=-1))
        inside = inside & (low_m <= high_m)
        return _inside(-low_m, inside), _inside(high_m, inside)


def ball(*, diameter_m: float) -> Ellipsoid:
    """Return a ball."""
    return Ellipsoid(length_m=diameter_m, width_m=diameter_m, height_m=diameter_m)


def ellipsoid(
    *,
    length_m: float,
    diameter_m: float | None = None,
    width_m: float | None = None,
    height_m: float | None = None,
) -> Ellipsoid:
    """Return an ellipsoid: one of revolution with ``diameter_m``, or with width and height."""
    if diameter_m is not None and width_m is None and height_m is None:
        return Ellipsoid(length_m=length_m, width_m=diameter_m, height_m=diameter_m)
    if diameter_m is None and width_m is not None and height_m is not None:
        return Ellipsoid(length_m=length_m, width_m=width_m, height_m=height_m)
    raise SimulatorSettingsError("an ellipsoid has a length and a diameter, or width and height")


def cylinder(*, diameter_m: float, length_m: float) -> Revolution:
    """Return a cylinder that lies between the pads."""
    require_positive(diameter_m=diameter_m)
    return Revolution(length_m=length_m, radius_m=lambda x_m: np.full(x_m.shape, 0.5 * diameter_m))


def dumbbell(
    *,
    length_m: float,
    diameter_m: float,
    waist_diameter_m: float | None = None,
    waist_length_m: float | None = None,
) -> Revolution:
    """Return a dumbbell: two rounded heads, between them a smooth waist.

    The heads' outer edges are quarter ellipses over half a head; the waist is one period of a
    cosine. By default it has 0.6 of the diameter and 6/13 of the length: the paper, which has a
    dumbbell of 13 mm and 10 mm, does not describe its waist.
    """
    if waist_diameter_m is None:
        waist_diameter_m = _WAIST_DIAMETER_SHARE * diameter_m
    if waist_length_m is None:
        waist_length_m = _WAIST_LENGTH_SHARE * length_m
    require_positive(
        diameter_m=diameter_m, waist_diameter_m=waist_diameter_m, waist_length_m=waist_length_m
    )
    if waist_diameter_m >= diameter_m or waist_length_m >= length_m:
        raise SimulatorSettingsError(
            f"the waist ({waist_diameter_m} m thick, {waist_length_m} m long) must be smaller "
            f"than the dumbbell ({diameter_m} m, {length_m} m)"
        )
    edge_m = 0.25 * (length_m - waist_length_m)
    edge_start_m = 0.5 * length_m - edge_m
    head_m, waist_m = 0.5 * diameter_m, 0.5 * waist_diameter_m

    def radius_m(x_m: NDArray[np.float64]) -> NDArray[np.float64]:
        in_waist = 0.5 * (1.0 - np.cos(2.0 * np.pi * np.minimum(x_m / waist_length_m, 0.5)))
        over = np.clip((x_m - edge_start_m) / edge_m, 0.0, 1.0)
        rounded_m = head_m - edge_m * (1.0 - np.sqrt(1.0 - over**2))
        return np.minimum(waist_m + (head_m - waist_m) * in_waist, rounded_m)

    return Revolution(length_m=length_m, radius_m=radius_m)


PAPER_OBJECTS: Mapping[str, Shape] = MappingProxyType(
    {
        "oval": Ellipsoid(length_m=14e-3, width_m=11.7e-3, height_m=11.7e-3),
        "cylinder": cylinder(diameter_m=6e-3, length_m=20e-3),
        "box": Box(length_m=15.9e-3, width_m=10e-3, height_m=10e-3),
        "ball": ball(diameter_m=9.5e-3),
        "dumbbell": dumbbell(length_m=13e-3, diameter_m=10e-3),
    }
)
"""The five objects of the paper's experiment (table in its section on results)."""
