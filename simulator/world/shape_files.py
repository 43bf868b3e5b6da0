"""Objects from text and from STL files: shapes with their lengths, triangles."""

import math
import re
from collections.abc import Callable, Mapping
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
"""More triangles than this are refused: a placement would take minutes."""
_MAX_BYTES = 300 * MAX_FACES
"""Largest file in bytes: 300 for each triangle as text, 50 as binary."""
_LARGEST = 1e6
"""Largest coordinate of a corner in units of the file: a kilometre in mm."""
_SMALLEST_M = 1e-3
"""Least length of the longest side in m: less lies between two taxels."""
_HEAD_BYTES = 84
"""Bytes before the triangles of a binary file: 80 of comment, 4 of their number."""
_EDGE_ON_M2 = 1e-18
"""Twice the area in m² below which a triangle is seen edge-on."""
_ON_EDGE = 1e-9
"""Allowance of barycentric coordinates, so that points on an edge belong to a triangle."""
_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_NUMBER = rb"[+-]?(?:[0-9]{1,20}(?:\.[0-9]{0,30})?|\.[0-9]{1,30})(?:[eE][+-]?[0-9]{1,3})?"
_VERTEX = re.compile(rb"(?i)vertex[ \t]+(%b)[ \t]+(%b)[ \t]+(%b)" % (_NUMBER, _NUMBER, _NUMBER))
_CORNER = rb"\s+vertex(?:[ \t]+%b){3}" % _NUMBER
_TEXT = re.compile(
    rb"(?i)(?:\xef\xbb\xbf)?\s*solid[^\r\n]*"
    rb"(?:\s+facet\s+normal(?:[ \t]+%b){3}\s+outer\s+loop(?:%b){3}"
    rb"\s+endloop\s+endfacet)+\s+endsolid[^\r\n]*\s*" % (_NUMBER, _CORNER)
)
"""An STL text file as its format is defined: one solid of triangles."""
_UNIT_M = 1e-3
"""Length of one unit of a file in m; STL has none, mm is what most programs write."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshShape:
    """A closed surface of triangles."""

    triangles_m: NDArray[np.float64] = field(repr=False)
    """(n, 3, 3) float64: corners of each triangle in m, centred; x is the long axis."""
    roll_step_rad: float = 0.0
    """Rolls in which it rests between the pads, multiples of this in rad; 0 allows any."""

    def __post_init__(self) -> None:
        triangles_m = np.array(self.triangles_m, dtype=np.float64)
        if triangles_m.ndim != 3 or triangles_m.shape[1:] != (3, 3) or len(triangles_m) == 0:
            raise SimulatorSettingsError(
                f"triangles have shape {triangles_m.shape}, expected (n, 3, 3)"
            )
        if len(triangles_m) > MAX_FACES:
            raise SimulatorSettingsError(
                f"the mesh has {len(triangles_m)} triangles, limit {MAX_FACES}"
            )
        if not np.all(np.isfinite(triangles_m)):
            raise SimulatorSettingsError("the mesh has corners that are not finite")
        triangles_m.setflags(write=False)
        object.__setattr__(self, "triangles_m", triangles_m)

    def heights(
        self, x_m: NDArray[np.float64], y_m: NDArray[np.float64], roll_rad: float
    ) -> Heights:
        """Take the lowest and the highest triangle over each point; see `Shape.heights`."""
        c, s = math.cos(roll_rad), math.sin(roll_rad)
        roll = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        low_m = np.full(x_m.size, np.inf)
        high_m = np.full(x_m.size, -np.inf)
        points_m = np.column_stack([x_m.ravel(), y_m.ravel()])
        # Points sorted by x: a triangle then looks only at its own stripe.
        order = np.argsort(points_m[:, 0], kind="stable")
        sorted_m = points_m[order]
        triangles_m = self.triangles_m @ roll.T
        first = np.searchsorted(sorted_m[:, 0], triangles_m[:, :, 0].min(axis=1), side="left")
        last = np.searchsorted(sorted_m[:, 0], triangles_m[:, :, 0].max(axis=1), side="right")
        for triangle_m, begin, end in zip(triangles_m, first, last, strict=True):
            _rasterise(triangle_m, sorted_m[begin:end], low_m[begin:end], high_m[begin:end])
        reach_0 = np.empty_like(low_m)
        reach_1 = np.empty_like(high_m)
        reach_0[order] = -low_m
        reach_1[order] = high_m
        return reach_0.reshape(x_m.shape), reach_1.reshape(x_m.shape)


def _rasterise(
    triangle_m: NDArray[np.float64],
    points_m: NDArray[np.float64],
    low_m: NDArray[np.float64],
    high_m: NDArray[np.float64],
) -> None:
    """Widen the range of heights at the points that lie under or over one triangle."""
    a, b, c = triangle_m
    edge_b, edge_c = b[:2] - a[:2], c[:2] - a[:2]
    area = edge_b[0] * edge_c[1] - edge_b[1] * edge_c[0]
    if abs(area) < _EDGE_ON_M2 or len(points_m) == 0:
        return  # seen edge-on: its neighbours cover the same points
    offset_m = points_m - a[:2]
    u = (offset_m[:, 0] * edge_c[1] - offset_m[:, 1] * edge_c[0]) / area
    v = (offset_m[:, 1] * edge_b[0] - offset_m[:, 0] * edge_b[1]) / area
    hit = (u >= -_ON_EDGE) & (v >= -_ON_EDGE) & (u + v <= 1.0 + _ON_EDGE)
    z_m = a[2] + u[hit] * (b[2] - a[2]) + v[hit] * (c[2] - a[2])
    low_m[hit] = np.minimum(low_m[hit], z_m)
    high_m[hit] = np.maximum(high_m[hit], z_m)


def load_mesh(path: Path) -> MeshShape:
    """Read an STL file, centred on its bounding box.

    Parameters
    ----------
    path
        The STL file, binary or text; its unit is 1 mm.

    Raises
    ------
    SimulatorSettingsError
        If the file is no STL, too large, no closed surface, or smaller than any part.
    ModuleNotFoundError
        If the extra ``mesh`` is not installed.
    """
    import trimesh  # noqa: PLC0415 (an extra, needed for mesh files only)

    triangles_m = _UNIT_M * _triangles(path)
    mesh = trimesh.Trimesh(
        vertices=triangles_m.reshape(-1, 3) / _UNIT_M,
        faces=np.arange(3 * len(triangles_m)).reshape(-1, 3),
    )
    # A triangle with a corner given twice has no area, and closes nothing.
    mesh.update_faces((mesh.faces != np.roll(mesh.faces, 1, axis=1)).all(axis=1))
    if not mesh.is_watertight:
        raise SimulatorSettingsError(
            f"{path} holds no closed surface; repair the mesh and export it again"
        )
    corners_m = triangles_m.reshape(-1, 3)
    size_m = np.ptp(corners_m, axis=0)
    if size_m.max() < _SMALLEST_M:
        size_mm = " x ".join(f"{1e3 * side_m:.3g}" for side_m in size_m)
        raise SimulatorSettingsError(
            f"{path} is {size_mm} mm in size, expected {1e3 * _SMALLEST_M:g} mm or more on one "
            f"side: its unit is {1e3 * _UNIT_M:g} mm; was it drawn in inches or m? Export it in mm"
        )
    centre_m = 0.5 * (corners_m.min(axis=0) + corners_m.max(axis=0))
    return MeshShape(triangles_m=triangles_m - centre_m)


def _triangles(path: Path) -> NDArray[np.float64]:
    """Return the corners of an STL file in its units, (n, 3, 3); sizes are checked before."""
    try:
        if not path.is_file():
            raise SimulatorSettingsError(f"{path} is no file; check the path")
        size = path.stat().st_size
        if size > _MAX_BYTES:
            raise SimulatorSettingsError(f"{path} has {size} bytes, at most {_MAX_BYTES} are read")
        data = path.read_bytes()
    except (OSError, ValueError) as error:
        raise SimulatorSettingsError(f"{path} cannot be read: {error}") from error
    n_faces = int.from_bytes(data[80:84], "little")
    if len(data) == _HEAD_BYTES + n_faces * _FACE.itemsize:
        faces = np.frombuffer(data, dtype=_FACE, offset=_HEAD_BYTES)
        with np.errstate(invalid="ignore"):  # what is no number is refused below
            corners = faces["corners"].astype(np.float64)
    elif _TEXT.fullmatch(data):
        numbers = [float(number) for line in _VERTEX.findall(data) for number in line]
        corners = np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)
    else:
        expected = _HEAD_BYTES + n_faces * _FACE.itemsize
        raise SimulatorSettingsError(
            f"{path} cannot be read as STL: neither text, nor binary ({len(data)} bytes, its count "
            f"of {n_faces} triangles needs {expected}); export it again, as binary STL"
        )
    if not 1 <= len(corners) <= MAX_FACES:
        raise SimulatorSettingsError(
            f"{path} has {len(corners)} triangles, must have 1 to {MAX_FACES}"
        )
    largest = float(np.abs(corners).max())
    if not largest <= _LARGEST:
        raise SimulatorSettingsError(
            f"{path} has a corner at {largest:g}, must be finite and at most {_LARGEST:g}"
        )
    return corners


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
    their units (``cylinder:diameter=6mm,length=20mm``); a mesh file in mm
    (``mesh:file=bolt.stl``).

    Raises
    ------
    SimulatorSettingsError
        If the text is none of them; the message names what is missing or unknown.
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
