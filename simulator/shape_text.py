"""Shapes written as text, as operators and the positioner's socket name them."""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

from simulator.errors import SimulatorSettingsError
from simulator.mesh import load_mesh
from simulator.shapes import PAPER_OBJECTS, Box, Shape, ball, cylinder, dumbbell, ellipsoid

_UNITS_M = {"um": 1e-6, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
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
"""Kind -> what builds it, the lengths it must have, those it may have."""


def parse_shape(text: str) -> Shape:
    """Read a shape from text.

    Three forms: the name of one of the paper's objects (``ball``); a kind with its lengths and
    their units (``cylinder:diameter=6mm,length=20mm``); a mesh file in mm
    (``mesh:file=bolt.stl``).

    Raises
    ------
    SimulatorSettingsError
        If the text is none of them; the message says what is missing or unknown.
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
