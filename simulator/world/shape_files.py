"""Objects from text and from STL files: shapes with their lengths, triangles."""

import io
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from simulator.errors import SimulatorSettingsError
from simulator.world.shapes import (
    PAPER_OBJECTS,
    Box,
    Heights,
    Shape,
    ball,
    cylinder,
    dumbbell,
    ellipsoid,
)

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
    if not mesh.is_watertight:
        raise SimulatorSettingsError(
            f"{path} has no closed surface; repair the mesh and export it again"
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
    return MeshShape(triangles_m=_UNIT_M * (mesh.triangles - mesh.bounds.mean(axis=0)))


_UNITS_M = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
"""Unit of a length in a text and its value in m."""
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+)\s*(um|mm|cm|m)")

_KINDS: Mapping[str, tuple[Callable[..., Shape], tuple[str, ...], tuple[str, ...]]] = (
    MappingProxyType(
        {
            "ball": (ball, ("diameter",), ()),
            "sphere": (ball, ("diameter",), ()),
            "cylinder": (cylinder, ("diameter", "length"), ()),
            "box": (Box, ("length", "width", "height"), ()),
            "ellipsoid": (ellipsoid, ("length",), ("diameter", "width", "height")),
            "dumbbell": (dumbbell, ("length", "diameter"), ("waist_diameter", "waist_length")),
        }
    )
)
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
