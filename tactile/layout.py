"""Pads and taxels: how many, where, which way they face.

Frames
------
Finger frame: origin in the middle of the inner (gripping) face, x along the finger towards the tip,
y across, z out of the inner face towards the other finger. The two fingers are mirror images in the
centre plane of the gripper: x and y point the same way for both. So taxels of equal row and column
on two equal inner pads face each other. The frame of finger 1 is left-handed.

Pad plane: origin in the pad's centre, x along the rows' direction, y along the columns' direction.
"""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile.errors import LayoutError

Face = Literal["inner", "outer", "side_a", "side_b", "tip"]
Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class Pad:
    """One rectangular field of taxels."""

    name: str
    """Unique in the layout."""
    finger: int
    """0 or 1."""
    face: Face
    """Side of the finger; the inner face grips."""
    rows: int
    columns: int
    """Number of taxels along the pad's x and y axis. Taxels are counted row by row."""
    pitch_x_m: float
    pitch_y_m: float
    """Distance of neighbours along x and along y in m."""
    centre_m: Vector = (0.0, 0.0, 0.0)
    """Centre of the pad in the finger frame in m."""
    x_axis: Vector = (1.0, 0.0, 0.0)
    y_axis: Vector = (0.0, 1.0, 0.0)
    """Unit vectors of the pad's plane in the finger frame; the normal is x cross y."""

    def __post_init__(self) -> None:
        if self.finger not in (0, 1):
            raise LayoutError(f"pad {self.name}: finger is {self.finger}, must be 0 or 1")
        if self.face not in get_args(Face):
            raise LayoutError(
                f"pad {self.name}: face is {self.face!r}, must be one of {get_args(Face)}"
            )
        if not (1 <= self.rows <= 255 and 1 <= self.columns <= 255):
            raise LayoutError(
                f"pad {self.name}: {self.rows} x {self.columns} taxels, each side must be 1 to 255"
            )
        for pitch in (self.pitch_x_m, self.pitch_y_m):
            if not (math.isfinite(pitch) and pitch > 0.0):
                raise LayoutError(f"pad {self.name}: pitch is {pitch} m, must be above 0")
        if not np.all(np.isfinite(self.centre_m)):
            raise LayoutError(f"pad {self.name}: centre {self.centre_m} is not finite")
        axes = np.array([self.x_axis, self.y_axis], dtype=np.float64)
        if not np.allclose(axes @ axes.T, np.eye(2), atol=1e-9):
            raise LayoutError(
                f"pad {self.name}: axes {self.x_axis}, {self.y_axis} are not orthonormal"
            )

    @property
    def n_taxels(self) -> int:
        """Number of taxels."""
        return self.rows * self.columns

    @property
    def normal(self) -> NDArray[np.float64]:
        """Outward normal in the finger frame, unit vector, shape (3,)."""
        return np.cross(np.array(self.x_axis), np.array(self.y_axis))

    def taxel_xy_m(self) -> NDArray[np.float64]:
        """Return the taxels' positions in the pad's plane in m, row by row, shape (n, 2)."""
        x_m = (np.arange(self.rows) - 0.5 * (self.rows - 1)) * self.pitch_x_m
        y_m = (np.arange(self.columns) - 0.5 * (self.columns - 1)) * self.pitch_y_m
        return np.stack([np.repeat(x_m, self.columns), np.tile(y_m, self.rows)], axis=1)


def _read_only(values: ArrayLike, dtype: type) -> NDArray[Any]:
    array: NDArray[Any] = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaxelLayout:
    """All pads of both fingers, in the order in which the control unit sends their taxels."""

    name: str
    """For messages; does not enter the hash."""
    pads: tuple[Pad, ...]
    """Pads in the order of transmission."""
    adc_max: int = 255
    """Full scale of the counts, 1 to 65535."""
    pad_shape: NDArray[np.int64] = field(init=False)
    """(n_pads, 2) int64: rows and columns."""
    taxel_pad: NDArray[np.int64] = field(init=False)
    """(n_taxels,) int64: pad of each taxel; row-major within a pad."""
    taxel_xy_m: NDArray[np.float64] = field(init=False)
    """(n_taxels, 2) float64: position in the pad's plane in m: x along the finger, y across."""
    gripping_pads: tuple[int, int] = field(init=False)
    """Index of the inner pad of finger 0 and of finger 1."""
    gripping_taxels: tuple[slice, slice] = field(init=False)
    """Where in a frame the taxels of these two pads are."""
    layout_hash: str = field(init=False)
    """16 hexadecimal digits over all that gives the samples their meaning."""

    def __post_init__(self) -> None:
        if not 1 <= self.adc_max <= 0xFFFF:
            raise LayoutError(
                f"layout {self.name}: adc_max is {self.adc_max}, must be 1 to {0xFFFF}"
            )
        names = [pad.name for pad in self.pads]
        if len(set(names)) != len(names):
            raise LayoutError(f"layout {self.name}: pad names repeat: {names}")
        inner = [
            [i for i, pad in enumerate(self.pads) if (pad.finger, pad.face) == (finger, "inner")]
            for finger in (0, 1)
        ]
        if [len(pads) for pads in inner] != [1, 1]:
            raise LayoutError(
                f"layout {self.name}: fingers 0 and 1 have {len(inner[0])} and {len(inner[1])} "
                "inner pads, each needs exactly one to grip with"
            )
        sizes = [pad.n_taxels for pad in self.pads]
        xy_m = [pad.taxel_xy_m() for pad in self.pads]
        derived: dict[str, Any] = {
            "pad_shape": _read_only([(pad.rows, pad.columns) for pad in self.pads], np.int64),
            "taxel_pad": _read_only(np.repeat(np.arange(len(sizes)), sizes), np.int64),
            "taxel_xy_m": _read_only(np.concatenate(xy_m), np.float64),
            "gripping_pads": (inner[0][0], inner[1][0]),
            "gripping_taxels": (self.taxels_of(inner[0][0]), self.taxels_of(inner[1][0])),
            "layout_hash": _layout_hash(self),
        }
        for key, value in derived.items():
            object.__setattr__(self, key, value)

    @property
    def n_pads(self) -> int:
        """Number of pads."""
        return len(self.pads)

    @property
    def n_taxels(self) -> int:
        """Number of taxels on all pads."""
        return len(self.taxel_pad)

    @property
    def sample_bits(self) -> int:
        """Size of a sample on the bus: 8, or 16 where the full scale needs it."""
        return 8 if self.adc_max <= 0xFF else 16

    def taxels_of(self, pad: int) -> slice:
        """Return where in a frame the taxels of a pad are; IndexError for a pad that is none."""
        if not 0 <= pad < self.n_pads:
            raise IndexError(f"pad {pad} does not exist, layout {self.name} has {self.n_pads}")
        start = sum(p.n_taxels for p in self.pads[:pad])
        return slice(start, start + self.pads[pad].n_taxels)

    def medians(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Return the median over each pad, (n_pads,), of one value for each taxel."""
        return np.array([np.median(values[self.taxels_of(pad)]) for pad in range(self.n_pads)])

    def on_fingers(self, values: NDArray[Any]) -> tuple[float, float]:
        """Return the sum over the gripping pad of each finger, of one value for each taxel."""
        first, second = (float(values[taxels].sum()) for taxels in self.gripping_taxels)
        return first, second

    def place(self, taxel: int) -> str:
        """Return pad, row and column of a taxel as text."""
        number = int(self.taxel_pad[taxel])
        pad = self.pads[number]
        row, column = divmod(taxel - self.taxels_of(number).start, pad.columns)
        return f"{pad.name} row {row} column {column}"


@dataclass(frozen=True, slots=True, kw_only=True)
class PadMount:
    """How a pad sits otherwise than the layout has it: exchanged, turned or mirrored."""

    pad: int
    """Number of the pad in the layout."""
    sent_as: int
    """Number of the pad in whose place the control unit sends its samples."""
    rows_mirrored: bool = False
    columns_mirrored: bool = False
    """Whether the unit sends the last row first, and the last column of each row; both: the pad is
    turned by 180 degrees."""


def taxel_order(layout: TaxelLayout, mounts: Sequence[PadMount]) -> NDArray[np.int64]:
    """Return the place in the unit's frames of each taxel of a layout, (n_taxels,) int64.

    Raises LayoutError if a pad does not exist, differs in rows or columns from the one whose place
    it has, or if two pads have the same place.

    Parameters
    ----------
    mounts
        Pads mounted differently than in the layout.
    """
    by_pad = {mount.pad: mount for mount in mounts}
    pads = range(layout.n_pads)
    places = [by_pad[pad].sent_as if pad in by_pad else pad for pad in pads]
    if len(by_pad) < len(mounts) or not by_pad.keys() <= set(pads) or sorted(places) != list(pads):
        raise LayoutError(
            f"mounts of layout {layout.name}: the pads 0 to {layout.n_pads - 1} are sent as "
            f"{places}; name each pad once"
        )
    order = np.arange(layout.n_taxels)
    for mount in by_pad.values():
        pad, other = layout.pads[mount.pad], layout.pads[mount.sent_as]
        if (pad.rows, pad.columns) != (other.rows, other.columns):
            raise LayoutError(
                f"pad {pad.name} has {pad.rows} x {pad.columns} taxels, but is sent as "
                f"{other.name} with {other.rows} x {other.columns}: correct sent_as in "
                "tactile.mounting"
            )
        taxels = layout.taxels_of(mount.sent_as)
        place = np.arange(taxels.start, taxels.stop).reshape(pad.rows, pad.columns)
        if mount.rows_mirrored:
            place = place[::-1]
        if mount.columns_mirrored:
            place = place[:, ::-1]
        order[layout.taxels_of(mount.pad)] = place.ravel()
    order.setflags(write=False)
    return order


def _layout_hash(layout: TaxelLayout) -> str:
    def nanometres(values_m: tuple[float, ...]) -> list[int]:
        return [round(value * 1e9) for value in values_m]

    content = {
        "adc_max": layout.adc_max,
        "sample_bits": layout.sample_bits,
        "pads": [
            {
                "finger": pad.finger,
                "face": pad.face,
                "shape": [pad.rows, pad.columns],
                "pitch_nm": nanometres((pad.pitch_x_m, pad.pitch_y_m)),
                "centre_nm": nanometres(pad.centre_m),
                "axes": [
                    [round(value, 6) + 0.0 for value in axis] for axis in (pad.x_axis, pad.y_axis)
                ],
            }
            for pad in layout.pads
        ],
    }
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


FINGER_M = (0.055, 0.020, 0.012)
"""Length, width and thickness of a finger (the paper, section 2: 55 x 20 x 12 mm)."""


def _finger_pads(finger: int) -> tuple[Pad, ...]:
    length, width, thickness = FINGER_M
    mid_z = -0.5 * thickness
    x, y, z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    minus_y, minus_z = (0.0, -1.0, 0.0), (0.0, 0.0, -1.0)
    # face, rows, columns, extent along the pad's x and y in m, centre, x axis, y axis
    faces: tuple[tuple[Face, int, int, float, float, Vector, Vector, Vector], ...] = (
        ("inner", 16, 4, length, width, (0.0, 0.0, 0.0), x, y),
        ("outer", 16, 4, length, width, (0.0, 0.0, -thickness), x, minus_y),
        ("side_a", 16, 2, length, thickness, (0.0, 0.5 * width, mid_z), x, minus_z),
        ("side_b", 16, 2, length, thickness, (0.0, -0.5 * width, mid_z), x, z),
        ("tip", 6, 2, width, thickness, (0.5 * length, 0.0, mid_z), y, z),
    )
    return tuple(
        Pad(
            name=f"finger{finger}.{face}",
            finger=finger,
            face=face,
            rows=rows,
            columns=columns,
            pitch_x_m=extent_x_m / rows,
            pitch_y_m=extent_y_m / columns,
            centre_m=centre_m,
            x_axis=x_axis,
            y_axis=y_axis,
        )
        for face, rows, columns, extent_x_m, extent_y_m, centre_m, x_axis, y_axis in faces
    )


def paper_layout() -> TaxelLayout:
    """Return the paper's sensor: 2 x 204 taxels of 8 bit.

    Per finger two 16 x 4 fields, two 16 x 2 fields and one 6 x 2 field (section 2); the pitch
    follows from the finger's size: 3.44 mm along and 5 mm across the inner face.
    """
    return TaxelLayout(name="paper", pads=_finger_pads(0) + _finger_pads(1))


def inner_pads(
    name: str, rows: int, columns: int, pitch_m: float, *, adc_max: int = 255
) -> TaxelLayout:
    """Return two equal opposing pads of rows along the fingers and columns across them."""
    pads = tuple(
        Pad(
            name=f"finger{finger}.inner",
            finger=finger,
            face="inner",
            rows=rows,
            columns=columns,
            pitch_x_m=pitch_m,
            pitch_y_m=pitch_m,
        )
        for finger in (0, 1)
    )
    return TaxelLayout(name=name, pads=pads, adc_max=adc_max)


def pinch_layout() -> TaxelLayout:
    """Return two opposing pads of 13 x 6 taxels at 3.4 mm pitch, 12 bit in 16 bit samples."""
    return inner_pads("pinch", 13, 6, 3.4e-3, adc_max=4095)


LAYOUTS: Mapping[str, Callable[[], TaxelLayout]] = {
    "flexitac_12x32": partial(inner_pads, "flexitac_12x32", 32, 12, 2e-3),
    "flexitac_16x16": partial(inner_pads, "flexitac_16x16", 16, 16, 2e-3),
    "flexitac_16x32": partial(inner_pads, "flexitac_16x32", 32, 16, 2e-3),
    "paper": paper_layout,
    "pinch": pinch_layout,
    "uskin_4x4": partial(inner_pads, "uskin_4x4", 4, 4, 4.7e-3, adc_max=65535),
}
"""Layouts that a config names. The long side of FlexiTac's pads lies along the finger; square
boards come in several pitches."""
