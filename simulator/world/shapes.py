"""Rigid objects as two surfaces over the plane of the pads, from text and from STL files.

Frame of an object: origin at its centre, x along its long axis, z along the closing axis when
rotation and roll are zero. Two height maps over x and y describe an object: the reach of its
surface from the centre plane towards finger 0 (in -z) and towards finger 1 (in +z).
"""

import io
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
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


PAPER_OBJECTS: Mapping[str, Shape] = {
    "oval": Ellipsoid(length_m=14e-3, width_m=11.7e-3, height_m=11.7e-3),
    "cylinder": cylinder(diameter_m=6e-3, length_m=20e-3),
    "box": Box(length_m=15.9e-3, width_m=10e-3, height_m=10e-3),
    "ball": ball(diameter_m=9.5e-3),
    "dumbbell": dumbbell(length_m=13e-3, diameter_m=10e-3),
}
"""The five objects of the paper's experiment (table in its section on results)."""


MAX_FACES = 200_000
"""Most triangles of a file: with more a placement would take seconds."""
_MAX_BYTES = 300 * MAX_FACES
"""Largest file in bytes: 300 for each triangle as text, 50 as binary."""
_SMALLEST_M, _LONGEST_M = 1e-3, 1.0
"""Smallest and largest length of the longest side in m: from the space between two taxels to the
largest part of a gripper."""
_EDGE_ON_M2 = 1e-18
"""Twice the area in m² below which a triangle is seen edge-on."""
_ON_EDGE = 1e-9
"""Allowance of barycentric coordinates, so that points on an edge belong to a triangle."""
_ROUNDING_M = 1e-12
"""Allowance in m for rounding where a point lies at the end of a triangle."""
_PAIRS = 500_000
"""Most pairs of triangle and point in one batch: 40 MB."""
_ROLL_DEG, _SIDE_DEG = 0.5, 10.0
"""Step of the rolls that are tried for a mesh, and least distance of two sides, in degrees."""
_ROUND_SHARE = 0.05
"""Difference of the heights of a round mesh, as a share: it rests at any roll."""
_UNIT_M = 1e-3
"""Length of one unit of a file in m; STL has none, mm is what most programs write."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshShape:
    """A closed surface of triangles."""

    triangles_m: NDArray[np.float64] = field(repr=False)
    """(n, 3, 3) float64: corners of each triangle in m, centred; x is the long axis."""
    roll_step_rad: float = 0.0
    """Rolls in which it rests between the pads, multiples of this in rad; 0 allows any."""

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> Heights:
        """Take the lowest and the highest triangle over each point; see `Shape.heights`."""
        c, s = math.cos(roll_rad), math.sin(roll_rad)
        roll = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        corners_m = self.triangles_m @ roll.T
        edges_m = corners_m[:, 1:, :2] - corners_m[:, :1, :2]
        area_m2 = edges_m[:, 0, 0] * edges_m[:, 1, 1] - edges_m[:, 0, 1] * edges_m[:, 1, 0]
        # Of one seen edge-on its neighbours cover the same points.
        seen = np.abs(area_m2) >= _EDGE_ON_M2
        corners_m, edges_m, area_m2 = corners_m[seen], edges_m[seen], area_m2[seen]
        points_m = np.column_stack([x_m.ravel(), y_m.ravel()])
        low_m = np.full(len(points_m), np.inf)
        high_m = np.full(len(points_m), -np.inf)
        for triangle, point in _near(corners_m, points_m):
            offset_m = points_m[point] - corners_m[triangle, 0, :2]
            b_m, c_m, area = edges_m[triangle, 0], edges_m[triangle, 1], area_m2[triangle]
            u = (offset_m[:, 0] * c_m[:, 1] - offset_m[:, 1] * c_m[:, 0]) / area
            v = (offset_m[:, 1] * b_m[:, 0] - offset_m[:, 0] * b_m[:, 1]) / area
            hit = (u >= -_ON_EDGE) & (v >= -_ON_EDGE) & (u + v <= 1.0 + _ON_EDGE)
            a_m, b_m, c_m = corners_m[triangle[hit], :, 2].T
            z_m = a_m + u[hit] * (b_m - a_m) + v[hit] * (c_m - a_m)
            np.minimum.at(low_m, point[hit], z_m)
            np.maximum.at(high_m, point[hit], z_m)
        return -low_m.reshape(x_m.shape), high_m.reshape(x_m.shape)


def _near(
    corners_m: NDArray[np.float64], points_m: NDArray[np.float64]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return candidate pairs of triangle and point, by their indices.

    The points are sorted into stripes along x, and by x within each stripe. A triangle is compared
    only with points in its part of its stripes.
    """
    n_stripes = max(1, math.isqrt(len(points_m)))
    first_m, last_m = points_m[:, 1].min(), points_m[:, 1].max()
    per_m = (n_stripes - 1) / max(last_m - first_m, _SMALLEST_M)

    def stripe(y_m: NDArray[np.float64]) -> NDArray[np.intp]:
        numbers: NDArray[np.intp] = ((y_m - first_m) * per_m).clip(0, n_stripes - 1).astype(np.intp)
        return numbers

    longest_m = 4.0 * max(np.abs(points_m[:, 0]).max(), np.abs(corners_m[:, :, 0]).max(initial=0.0))
    place_m = longest_m * stripe(points_m[:, 1]) + points_m[:, 0]
    order = np.argsort(place_m)
    place_m = place_m[order]
    lowest, highest = stripe(corners_m[:, :, 1].min(axis=1)), stripe(corners_m[:, :, 1].max(axis=1))
    triangle, stripes = _ranges(lowest, highest + 1)
    begin_m, end_m = corners_m[:, :, 0].min(axis=1), corners_m[:, :, 0].max(axis=1)
    begin = np.searchsorted(place_m, longest_m * stripes + begin_m[triangle] - _ROUNDING_M)
    end = np.searchsorted(place_m, longest_m * stripes + end_m[triangle] + _ROUNDING_M)
    pieces = np.array_split(np.arange(len(triangle)), 1 + int((end - begin).sum()) // _PAIRS)
    for piece in pieces:
        which, at = _ranges(begin[piece], end[piece])
        yield triangle[piece[which]], order[at]


def _ranges(
    begin: NDArray[np.intp], end: NDArray[np.intp]
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return all integers of several ranges in a row: the index of the range, and the integer."""
    lengths = end - begin
    which = np.repeat(np.arange(len(lengths)), lengths)
    before = np.cumsum(lengths) - lengths
    return which, np.arange(len(which)) - before[which] + begin[which]


def load_mesh(path: Path) -> MeshShape:
    """Return the shape in an STL file in mm, binary or text, centred on its bounding box.

    Raises SimulatorSettingsError if the file cannot be read, is too large, has no closed surface,
    several bodies, or another unit. Raises ModuleNotFoundError if the extra ``mesh`` is not
    installed.
    """
    import trimesh  # noqa: PLC0415 (an extra, needed for mesh files only)

    if not path.is_file():
        raise SimulatorSettingsError(f"there is no file {path}: check the path")
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"it has more than {_MAX_BYTES} bytes")
        with np.errstate(invalid="ignore"):  # what is no number is refused below
            mesh = trimesh.load_mesh(io.BytesIO(path.read_bytes()), file_type="stl")
            mesh.merge_vertices()
            mesh.update_faces(mesh.nondegenerate_faces())
    except Exception as error:  # whatever its parser raises for damaged data
        # The parser guesses the encoding of a text that is no UTF-8 with a package of its own.
        why = "it is damaged" if isinstance(error, ImportError) else error
        raise SimulatorSettingsError(
            f"{path} cannot be read as STL: {why}; export it again, as binary STL"
        ) from error
    if len(mesh.faces) > MAX_FACES:
        raise SimulatorSettingsError(
            f"{path} has {len(mesh.faces)} triangles, must have at most {MAX_FACES}"
        )
    if not len(mesh.faces) or not mesh.is_watertight:
        raise SimulatorSettingsError(
            f"{path} has no closed surface; repair the mesh and export it again as STL"
        )
    if not _SMALLEST_M <= _UNIT_M * mesh.extents.max() <= _LONGEST_M:
        size_mm = " x ".join(f"{side_mm:.3g}" for side_mm in mesh.extents)
        raise SimulatorSettingsError(
            f"{path} is {size_mm} mm in size, expected {1e3 * _SMALLEST_M:g} to "
            f"{1e3 * _LONGEST_M:g} mm on the longest side. Its unit must be {1e3 * _UNIT_M:g} mm: "
            f"export it in mm"
        )
    if mesh.body_count > 1:
        raise SimulatorSettingsError(
            f"{path} has {mesh.body_count} bodies or cavities, but a gripper holds one part: "
            "unite them and export one body"
        )
    triangles_m = _UNIT_M * (mesh.triangles - mesh.bounds.mean(axis=0))
    return _lying(np.roll(triangles_m, -int(np.argmax(mesh.extents.round(3))), axis=2))


def _lying(triangles_m: NDArray[np.float64]) -> MeshShape:
    """Return a mesh that rests on its flattest side; its long axis is x."""
    corners_m = np.unique(triangles_m[:, :, 1:].reshape(-1, 2), axis=0)
    rolls_rad = np.radians(np.arange(0.0, 180.0, _ROLL_DEG))
    heights_m = np.array([np.ptp(corners_m @ (math.sin(a), math.cos(a))) for a in rolls_rad])
    near = round(_SIDE_DEG / _ROLL_DEG)
    lowest_m = np.min([np.roll(heights_m, n) for n in range(-near, near + 1)], axis=0)
    sides_rad = rolls_rad[heights_m == lowest_m]
    uneven_rad = np.ptp(np.diff(sides_rad, append=math.pi + sides_rad[0]))
    step_rad = math.pi / (len(sides_rad) if uneven_rad < math.radians(_SIDE_DEG) else 1)
    if np.ptp(heights_m) < _ROUND_SHARE * heights_m.max():
        step_rad = 0.0
    c, s = (function(rolls_rad[heights_m.argmin()]) for function in (math.cos, math.sin))
    triangles_m = triangles_m @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    return MeshShape(triangles_m=triangles_m, roll_step_rad=step_rad)


_UNITS_M = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Unit of a length in a text and its value in m."""
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(um|mm|cm|m)")

_KINDS: Mapping[str, tuple[Callable[..., Shape], tuple[str, ...], tuple[str, ...]]] = {
    "ball": (ball, ("diameter",), ()),
    "sphere": (ball, ("diameter",), ()),
    "cylinder": (cylinder, ("diameter", "length"), ()),
    "box": (Box, ("length", "width", "height"), ()),
    "ellipsoid": (ellipsoid, ("length",), ("diameter", "width", "height")),
    "dumbbell": (dumbbell, ("length", "diameter"), ("waist_diameter", "waist_length")),
}
"""Kind of shape: its function, the lengths that it needs, those that it may have."""


def parse_shape(text: str) -> Shape:
    """Read a shape from text.

    Three forms: the name of one of the paper's objects (``ball``); a kind with its lengths and
    their units (``cylinder:diameter=6mm,length=20mm``); a mesh file in mm (``mesh:file=bolt.stl``).
    Raises SimulatorSettingsError for any other text; the message has the missing or unknown item.
    """
    if text in PAPER_OBJECTS:
        return PAPER_OBJECTS[text]
    kind, colon, rest = text.partition(":")
    if kind == "mesh" and rest.startswith("file="):
        return load_mesh(Path(rest.removeprefix("file=")))
    if kind not in _KINDS or not colon:
        raise SimulatorSettingsError(
            f"unknown shape {text!r}: give one of {', '.join(PAPER_OBJECTS)}, or "
            f"KIND:NAME=LENGTH,... with one of {', '.join(_KINDS)}, or mesh:file=FILE.stl"
        )
    build, needed, optional = _KINDS[kind]
    lengths_m = _lengths_m(kind, rest)
    if not set(needed) <= set(lengths_m) <= {*needed, *optional}:
        also = f", may have {', '.join(optional)}" if optional else ""
        raise SimulatorSettingsError(
            f"a {kind} needs {', '.join(needed)}{also}; got {', '.join(lengths_m)}"
        )
    return build(**{f"{name}_m": value for name, value in lengths_m.items()})


def _lengths_m(kind: str, text: str) -> dict[str, float]:
    lengths_m: dict[str, float] = {}
    for item in text.split(","):
        name, equals, value = (part.strip() for part in item.partition("="))
        match = _LENGTH.fullmatch(value)
        if not equals or match is None:
            raise SimulatorSettingsError(
                f"{kind}: {item.strip()!r} is not NAME=LENGTH with a unit of "
                f"{', '.join(_UNITS_M)}, as in diameter=6mm"
            )
        if name in lengths_m:
            raise SimulatorSettingsError(f"{kind}: {name} is given twice")
        lengths_m[name] = float(match[1]) * _UNITS_M[match[2]]
    return lengths_m
