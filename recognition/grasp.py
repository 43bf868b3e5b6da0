"""Grasp record: the frames of one force ramp, its pads and its commanded pose and force."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from recognition.records import ArrayRecord, Numbers

CELL_SOURCE = "cell "
"""Start of the source of a grasp by a cell; the name of the cell follows."""
DRAWING_SOURCE = "drawing"
"""Source of a virtual grasp of a drawing."""

SERIES_PAUSE_MS = 3_600_000
"""Least pause in ms between two grasps of one object that begins a new series."""

QUIET_FRAMES = 3
"""Frames at the start of a grasp in which the pads count as untouched, if their load is small."""
_FARTHEST_ZERO_M = 0.05
"""Largest zero of an opening in m: far beyond that of any hand."""
_SAME_PLACE_M = 1e-6
"""Largest difference in m between positions of the same taxel: files round positions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GraspCommand(Numbers):
    """Commanded pose and force of one grasp; the pose that was reached may differ.

    Raises
    ------
    ValueError
        A number is not finite.
    """

    x_m: float
    y_m: float
    """Offset of the object along the fingers and across them in m."""
    rotation_rad: float
    roll_rad: float
    """Turn about the closing axis, and before that about the object's own axis, in rad."""
    force_n: float
    """Force at the end of the ramp in N."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SelfZero(Numbers):
    """Measurements of the empty fingers of a cell pressed on each other; logarithms are natural.

    Raises
    ------
    ValueError
        A number is not finite, or a deviation not above 0.
    """

    opening_m: float
    opening_sd_m: float
    """Reading of the opening when the middles of the pads just meet, in m, and its standard
    deviation."""
    log_gain_ratio: float
    log_gain_ratio_sd: float
    """Logarithm of the gain of finger 0's pad over that of finger 1's: both carry one force."""
    log_stiffness: float
    log_stiffness_sd: float
    """Logarithm of the counts of a pad, mean of both, for each mm that both yield together."""

    def __post_init__(self) -> None:
        Numbers.__post_init__(self)
        if abs(self.opening_m) > _FARTHEST_ZERO_M:
            raise ValueError(f"opening_m of a self-zero is {self.opening_m}, must be in m")


COMMAND_COLUMNS, ZERO_COLUMNS = (
    tuple(column.name for column in fields(kind)) for kind in (GraspCommand, SelfZero)
)
"""Names of the numbers of a `GraspCommand` and of a `SelfZero`, in their order."""


def keep_array(
    record: object,
    name: str,
    values: ArrayLike,
    dtype: DTypeLike | None = None,
    shape: tuple[int, ...] | None = None,
) -> NDArray[Any]:
    """Set a field of a frozen record to a read-only array, and return it.

    It is a copy, except of an array that nobody can write: that of another record, or its part.
    Raises ValueError for another shape than the given one.
    """
    array: NDArray[Any] = np.asarray(values, dtype=dtype)
    owner = array if array.base is None else array.base
    if array.flags.writeable or not isinstance(owner, np.ndarray) or owner.flags.writeable:
        array = array.copy()
        array.setflags(write=False)
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}, expected {shape}")
    object.__setattr__(record, name, array)
    return array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PadArray(ArrayRecord):
    """Positions of the taxels on their pads, and the full scale of their counts."""

    pad_shape: NDArray[np.int64]
    """(n_pads, 2) int64: rows and columns of each pad."""
    taxel_pad: NDArray[np.int64]
    """(n_taxels,) int64: pad of each taxel; row-major within a pad."""
    taxel_xy_m: NDArray[np.float64]
    """(n_taxels, 2) float64: position in the pad's plane in m: x along the finger, y across."""
    adc_max: int
    """int: full scale of the counts."""

    def __post_init__(self) -> None:
        n_pads = len(np.atleast_2d(self.pad_shape))
        n_taxels = len(np.atleast_1d(self.taxel_pad))
        keep_array(self, "pad_shape", self.pad_shape, np.int64, (n_pads, 2))
        keep_array(self, "taxel_pad", self.taxel_pad, np.int64, (n_taxels,))
        keep_array(self, "taxel_xy_m", self.taxel_xy_m, np.float64, (n_taxels, 2))
        if self.adc_max not in range(1, 1 << 16):
            raise ValueError(f"adc_max is {self.adc_max}, must be a whole number from 1 to 65535")
        if np.any(self.pad_shape < 1):
            raise ValueError(f"pad_shape is {self.pad_shape.tolist()}: a pad has no taxel")
        if not np.all(np.isfinite(self.taxel_xy_m)):
            raise ValueError("taxel_xy_m has values that are not finite")
        if np.any((self.taxel_pad < 0) | (self.taxel_pad >= n_pads)):
            raise ValueError(f"taxel_pad names other pads than the {n_pads} of pad_shape")
        per_pad = np.bincount(self.taxel_pad, minlength=n_pads)
        if np.any(per_pad != self.pad_shape.prod(axis=1)):
            raise ValueError(
                f"taxel_pad has {per_pad.tolist()} taxels on the pads, "
                f"pad_shape has {self.pad_shape.prod(axis=1).tolist()}"
            )

    @classmethod
    def grid(
        cls, rows: int, columns: int, pitch_m: float, *, n_pads: int = 2, adc_max: int = 4095
    ) -> "PadArray":
        """Return equal pads, each a grid of taxels around its centre; two pads by default.

        ``grid(8, 8, 3e-3)`` has 128 taxels: 64 on each of the two gripping pads. A grasp has the
        counts of both, pad by pad; ``n_pads=1`` describes a single pad.

        Parameters
        ----------
        rows, columns
            Taxels of each pad, along the finger and across it.
        pitch_m
            Distance between two of them in m.
        n_pads
            Number of pads.
        adc_max
            Full scale of the counts.
        """
        x, y = np.indices((rows, columns), dtype=np.float64).reshape(2, -1)
        xy_m = pitch_m * np.column_stack([x - 0.5 * (rows - 1), y - 0.5 * (columns - 1)])
        return cls(
            pad_shape=np.tile([rows, columns], (n_pads, 1)),
            taxel_pad=np.repeat(np.arange(n_pads), rows * columns),
            taxel_xy_m=np.tile(xy_m, (n_pads, 1)),
            adc_max=adc_max,
        )

    @property
    def n_pads(self) -> int:
        """Number of pads."""
        return len(self.pad_shape)

    @property
    def n_taxels(self) -> int:
        """Number of taxels on all pads."""
        return len(self.taxel_pad)

    def taxels_of(self, pad: int) -> NDArray[np.int64]:
        """Return the indices of one pad's taxels, row-major, shape (rows * columns,)."""
        return np.flatnonzero(self.taxel_pad == pad)

    def same_as(self, other: "PadArray") -> bool:
        """Return whether both describe the same pads: positions within 1 µm, full scale, shapes."""
        return (
            self.adc_max == other.adc_max
            and np.array_equal(self.pad_shape, other.pad_shape)
            and np.array_equal(self.taxel_pad, other.taxel_pad)
            and np.allclose(self.taxel_xy_m, other.taxel_xy_m, atol=_SAME_PLACE_M)
        )

    def check(self, pads: "PadArray") -> None:
        """Raise ValueError for other pads than these, the taught ones."""
        if pads is not self and not self.same_as(pads):
            raise ValueError(
                f"the grasp was taken on pads {pads.pad_shape.tolist()} with full scale "
                f"{pads.adc_max}, taught were {self.pad_shape.tolist()} with {self.adc_max}: "
                "teach on these pads"
            )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Grasp:
    """One force ramp on one object: from the open gripper to the full force.

    Raises
    ------
    ValueError
        There is no frame, a shape does not fit, counts are not from 0 to ``pads.adc_max``, or
        times fall.
    """

    pads: PadArray
    """The pads of the counts."""
    counts: NDArray[np.uint16]
    """(n_frames, n_taxels) uint16: raw frames, in the order of time; other numbers are rounded."""
    t_s: NDArray[np.float64]
    """(n_frames,) float64: time since the first frame in s."""
    aperture_m: NDArray[np.float64] = field(default_factory=lambda: np.array(np.nan))
    """(n_frames,) float64: opening between the fingers in m; NaN if unknown. A single number is
    used for all frames."""
    force_n: NDArray[np.float64] = field(default_factory=lambda: np.array(np.nan))
    """(n_frames,) float64: commanded grip force in N, likewise."""
    label: str = ""
    shape: str = ""
    source: str = ""
    """The object, its class of shape, and the source of the record (``cell NAME`` for a grasp by a
    cell); empty if unknown."""
    start_ms: int = 0
    """Time of the first frame in ms: sorts the grasps of a label, and shows their session."""
    series: str = ""
    """Series of the grasp: an individual of a kind, or a day. Empty: see `series_of`."""
    thickness_m: float = float("nan")
    """Thickness of the object along the closing axis in m by its drawing; NaN if unknown."""
    command: GraspCommand | None = None
    """Commanded pose and force; None if unknown. Recognizers do not use it."""
    zero: SelfZero | None = None
    """Last self-zero before the grasp; None if it was not measured."""

    def __post_init__(self) -> None:
        n_frames = len(self.counts)
        if n_frames < 1:
            raise ValueError("a grasp needs at least one frame")
        counts = np.asarray(self.counts)
        if counts.dtype.kind == "f":
            counts = np.rint(counts)
        low, high = counts.min(), counts.max()
        if not (low >= 0 and high <= self.pads.adc_max):
            raise ValueError(
                f"counts go from {low:g} to {high:g}, must be from 0 to adc_max = "
                f"{self.pads.adc_max}"
            )
        if counts.shape != (n_frames, self.pads.n_taxels):
            per_pad = " + ".join(str(n) for n in self.pads.pad_shape.prod(axis=1))
            raise ValueError(
                f"counts has shape {counts.shape}, expected {(n_frames, self.pads.n_taxels)}: one "
                f"column for each taxel of the {self.pads.n_pads} pads, {per_pad}"
            )
        keep_array(self, "counts", counts, np.uint16, counts.shape)
        for name in ("t_s", "aperture_m", "force_n"):
            value = getattr(self, name)
            if np.ndim(value) == 0 and name != "t_s":
                value = np.full(n_frames, value)
            keep_array(self, name, value, np.float64, (n_frames,))
        if not np.all(np.isfinite(self.t_s)) or np.any(np.diff(self.t_s) < 0.0):
            raise ValueError("t_s falls, or has a value that is not finite: write times in s")

    @property
    def n_frames(self) -> int:
        """Number of frames."""
        return len(self.counts)

    @property
    def rest_counts(self) -> NDArray[np.float64]:
        """(n_taxels,) float64: mean counts of the first frames, before the first touch."""
        rest: NDArray[np.float64] = self.counts[:QUIET_FRAMES].mean(axis=0)
        return rest

    @property
    def commanded(self) -> bool:
        """Whether the commanded force is known, of every frame."""
        return bool(np.all(np.isfinite(self.force_n)))

    @property
    def contact_frame(self) -> int | None:
        """First frame under a commanded force; None if that does not show the contact.

        A cell stops at the contact and begins the ramp there. The opening then shows the size for
        a ramp of any rate. Other hands may command a force before they touch.
        """
        if not (self.source == DRAWING_SOURCE or self.source.startswith(CELL_SOURCE)):
            return None
        forces_n = self.force_n[: int(np.argmax(self.force_n)) + 1]
        without = np.flatnonzero(forces_n <= 0.0)
        begun = self.commanded and len(without) and forces_n[-1] > 0.0
        return int(without[-1]) + 1 if begun else None

    def first_frames(self, n_frames: int) -> "Grasp":
        """Return the same grasp with its first frames only."""
        return replace(
            self,
            counts=self.counts[:n_frames],
            t_s=self.t_s[:n_frames],
            aperture_m=self.aperture_m[:n_frames],
            force_n=self.force_n[:n_frames],
        )


def by_label(grasps: Sequence[Grasp]) -> dict[str, list[Grasp]]:
    """Return the grasps of each label in the order of time, labels sorted.

    Raises ValueError if a grasp has no printable label.
    """
    members: defaultdict[str, list[Grasp]] = defaultdict(list)
    for number, grasp in enumerate(grasps):
        if not grasp.label or not grasp.label.isprintable():
            raise ValueError(
                f"grasp {number} has no label that can be printed: label it to teach or to test"
            )
        members[grasp.label].append(grasp)
    return {label: sorted(members[label], key=lambda g: g.start_ms) for label in sorted(members)}


def series_of(grasps: Sequence[Grasp]) -> list[list[Grasp]]:
    """Return the series of grasps of one object, each in the order of time.

    Without a name, a pause of an hour begins a new series.
    """
    series: list[list[Grasp]] = []
    for grasp in sorted(grasps, key=lambda g: (g.series, g.start_ms)):
        last = series[-1][-1] if series else grasp
        paused = not grasp.series and grasp.start_ms - last.start_ms > SERIES_PAUSE_MS
        if not series or paused or grasp.series != last.series:
            series.append([])
        series[-1].append(grasp)
    return series
