"""Grasp data sets: the format ``grasp-dataset/1``, an npz archive without pickled objects.

============== =========================== ======================================================
array          dtype, shape                meaning
============== =========================== ======================================================
format         str                         ``grasp-dataset/1``
adc_max        int                         full scale of ``counts``
pad_shape      int (n_pads, 2)             rows, columns of each pad
taxel_pad      int (n_taxels,)             pad of each taxel; row-major within a pad
taxel_xy_mm    float (n_taxels, 2)         x along the finger, y across, in mm
grasp_offsets  int (n_grasps + 1,)         grasp i has the frames offsets[i] to offsets[i + 1]
counts         uint16 (n_frames, n_taxels) raw frames of all grasps, one after the other
t_s            float (n_frames,)           time since the grasp's first frame in s
aperture_mm    float (n_frames,)           opening between the fingers in mm; NaN where unknown
force_n        float (n_frames,)           commanded grip force in N; NaN where unknown; optional
label          str (n_grasps,)             grasped object; empty where unknown
start_ms       int (n_grasps,)             time of the grasp's first frame
shape          str (n_grasps,)             class of shape; optional
source         str (n_grasps,)             its origin; optional
series         str (n_grasps,)             individual or day; optional. Where it is empty, a pause
                                           of an hour begins a new series
thickness_mm   float (n_grasps,)           of the object along the closing axis by its drawing in
                                           mm; NaN where unknown; optional
pose           float (n_grasps, 5)         commanded: ``recognition.grasp.COMMAND_COLUMNS``;
                                           a row of NaN where unknown; optional
self_zero      float (n_grasps, 8)         self-zero of the empty fingers before:
                                           ``recognition.grasp.ZERO_COLUMNS``; a row of NaN where
                                           it was not measured; optional
============== =========================== ======================================================
"""

import functools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.errors import DatasetError, raised_as
from cell.files import DATASET, array_names, check_text, read_npz, savez, write_atomically
from cell.recording.grasp_limits import RANGES, check_range, check_sizes, check_times
from recognition.grasp import COMMAND_COLUMNS, ZERO_COLUMNS, Grasp, GraspCommand, PadArray, SelfZero

DATASET_LIMIT_BYTES = 1 << 30
"""Default limit of the unpacked size of a data set in bytes."""
IN_MODEL = "grasps."
"""Prefix of the arrays of a data set in a model file."""


class _Array(NamedTuple):
    """An array of the file."""

    kinds: str
    """Kinds of its numpy type."""
    axes: str
    """Its axes; arrays with the same axis have the same length along it."""
    stored: str
    """Name in the file."""
    unit: float = 1.0
    """Unit in the file."""
    optional: bool = False


_ARRAYS = {
    "format": _Array("U", "", "format"),
    "adc_max": _Array("iu", "", "adc_max"),
    "pad_shape": _Array("iu", "pads xy", "pad_shape"),
    "taxel_pad": _Array("iu", "taxels", "taxel_pad"),
    "taxel_xy_m": _Array("f", "taxels xy", "taxel_xy_mm", 1e3),
    "grasp_offsets": _Array("iu", "offsets", "grasp_offsets"),
    "counts": _Array("u", "frames taxels", "counts"),
    "t_s": _Array("f", "frames", "t_s"),
    "aperture_m": _Array("f", "frames", "aperture_mm", 1e3),
    "label": _Array("U", "grasps", "label"),
    "start_ms": _Array("iu", "grasps", "start_ms"),
    "force_n": _Array("f", "frames", "force_n", optional=True),
    "shape": _Array("U", "grasps", "shape", optional=True),
    "source": _Array("U", "grasps", "source", optional=True),
    "series": _Array("U", "grasps", "series", optional=True),
    "thickness_m": _Array("f", "grasps", "thickness_mm", 1e3, optional=True),
    "command": _Array("f", "grasps command", "pose", optional=True),
    "zero": _Array("f", "grasps zero", "self_zero", optional=True),
}
"""The arrays by the name in `recognition.Grasp`."""
_RECORDS: Mapping[str, tuple[tuple[str, ...], Any]] = {
    "command": (COMMAND_COLUMNS, GraspCommand),
    "zero": (ZERO_COLUMNS, SelfZero),
}
"""Columns and kind of the arrays whose rows are records."""
_AXES = {"xy": 2, **{name: len(columns) for name, (columns, _) in _RECORDS.items()}}
"""Length of the axes that are the same in all data sets."""


def read_dataset(
    path: Path | str, *, limit_bytes: int = DATASET_LIMIT_BYTES, prefix: str = ""
) -> tuple[Grasp, ...]:
    """Read all grasps of a data set that unpacks to at most ``limit_bytes`` bytes.

    They share one `PadArray` object. With the ``prefix`` `IN_MODEL` it is the data set in a model.

    Raises
    ------
    DatasetError
        Naming the file, the array, the value and the limit.
    """
    path = Path(path)
    named = read_npz(
        path,
        error=DatasetError,
        what="grasp data set",
        limit_bytes=limit_bytes,
        wanted=lambda name: name.startswith(prefix),
    )
    arrays = {name.removeprefix(prefix): array for name, array in named.items()}
    if "format" in arrays:
        DATASET.check(str(arrays["format"]), path, DatasetError)
    stored = {array.stored: array.optional for array in _ARRAYS.values()}
    missing = [name for name, optional in stored.items() if name not in arrays and not optional]
    if missing and (prefix or "model" in arrays):
        raise DatasetError(f"{path} is a model, not a data set: name another file")
    if missing:
        raise DatasetError(f"{path} is not a grasp data set: {', '.join(missing)} missing")
    if unknown := [name for name in arrays if name not in stored]:
        raise DatasetError(f"{path}: unknown arrays {', '.join(map(repr, unknown))}")
    # A signalling NaN, or differences of infinite times; both are refused.
    with raised_as(DatasetError, ValueError, where=str(path)), np.errstate(invalid="ignore"):
        return _grasps_of(arrays)


def read_grasps(path: Path | str) -> tuple[Grasp, ...]:
    """Read the grasps of a data set or model, or of a recording if the file is an ``.mcap``.

    Raises DatasetError or cell.errors.RecordingError if the file cannot be read, or has no whole
    grasp.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        return read_dataset(path, prefix=IN_MODEL if "model" in array_names(path) else "")
    from cell.recording.reader import recording_grasps  # noqa: PLC0415  slow to load

    return recording_grasps(path)


def write_dataset(path: Path | str, grasps: Sequence[Grasp]) -> None:
    """Write grasps as one data set, whole or not at all; an older file stays until then.

    Raises DatasetError as `dataset_arrays`, or if the write fails.
    """
    path, arrays = Path(path), dataset_arrays(path, grasps)
    write_atomically(
        path, lambda file: savez(file, arrays), error=DatasetError, what="grasp data set"
    )


def dataset_arrays(path: Path | str, grasps: Sequence[Grasp]) -> dict[str, NDArray[Any]]:
    """Return the arrays of a data set for a file.

    Raises DatasetError if there is no grasp, the pads differ, a text cannot be stored, or it would
    be too long to be read again.
    """
    if not grasps:
        raise DatasetError(f"cannot write {path}: there is no grasp to write")
    with raised_as(DatasetError, ValueError, where=f"cannot write {path}"):
        arrays = _arrays_of(grasps)
        _grasps_of(arrays)
        if (size := sum(array.nbytes for array in arrays.values())) > DATASET_LIMIT_BYTES:
            raise ValueError(
                f"it would unpack to {size} bytes, the limit is {DATASET_LIMIT_BYTES}; write the "
                "new grasps to another file, or select fewer"
            )
    return arrays


def _arrays_of(grasps: Sequence[Grasp]) -> dict[str, NDArray[Any]]:
    pads = grasps[0].pads
    for i, grasp in enumerate(grasps):
        if grasp.pads is not pads and not grasp.pads.same_as(pads):
            raise ValueError(
                f"grasp {i} was taken on other pads than grasp 0; write one data set for each "
                "kind of pads"
            )
    arrays: dict[str, NDArray[Any]] = {
        "format": np.array(str(DATASET)),
        "adc_max": np.array(pads.adc_max, dtype=np.int64),
        "pad_shape": pads.pad_shape,
        "taxel_pad": pads.taxel_pad,
        "taxel_xy_mm": (1e3 * pads.taxel_xy_m).astype(np.float32),
        "grasp_offsets": np.cumsum([0, *(grasp.n_frames for grasp in grasps)], dtype=np.int64),
    }
    for name, (kinds, axes, stored, unit, optional) in _ARRAYS.items():
        if not axes.startswith(("frames", "grasps")):
            continue
        values = [getattr(grasp, name) for grasp in grasps]
        if name in _RECORDS:
            empty = (math.nan,) * len(_RECORDS[name][0])
            values = [record.values if record else empty for record in values]
        if kinds == "U":
            for text in values:  # an array loses a zero at the end
                check_text(name, text)
        array = np.concatenate(values) if axes.startswith("frames") else np.array(values)
        if optional and (array == "" if kinds == "U" else np.isnan(array)).all():
            continue
        small = kinds == "f" and name not in _RECORDS
        arrays[stored] = (unit * array).astype(np.float32) if small else array
    return arrays


def _grasps_of(in_file: Mapping[str, NDArray[Any]]) -> tuple[Grasp, ...]:
    """Return the grasps. Raises ValueError for an array that is refused, or does not fit."""
    lengths: dict[str, int] = dict(_AXES)
    arrays: dict[str, NDArray[Any]] = {}
    for name, (kinds, axes, stored, unit, _) in _ARRAYS.items():
        if stored not in in_file:
            continue
        array = in_file[stored]
        for axis, length in zip(axes.split(), array.shape, strict=False):
            lengths.setdefault(axis, length)
        expected = tuple(lengths.get(axis) for axis in axes.split())
        if array.dtype.kind not in kinds or array.shape != expected:
            raise ValueError(
                f"array {stored} has the type {array.dtype} and the shape {array.shape}, expected "
                f"kind {kinds} and shape {expected}"
            )
        if name in RANGES:
            check_range(name, array[:, :2] if name == "command" else array, stored, unit)
        arrays[name] = array.astype(np.float64) / unit if kinds == "f" else array
    pads = PadArray(
        **{name: arrays[name] for name in ("pad_shape", "taxel_pad", "taxel_xy_m")},
        adc_max=int(arrays["adc_max"]),
    )
    check_sizes(pads, arrays["aperture_m"])
    offsets, n_frames, n_grasps = arrays["grasp_offsets"], lengths["frames"], lengths["grasps"]
    offsets = offsets.astype(np.int64)
    if (
        (n_grasps < 1 or len(offsets) != n_grasps + 1)
        or (offsets[0] != 0 or offsets[-1] != n_frames)
        or np.any(offsets[1:] <= offsets[:-1])
    ):
        raise ValueError(
            f"array grasp_offsets must have {n_grasps + 1} numbers for {n_grasps} grasps, which "
            f"rise from 0 to the {n_frames} frames"
        )
    check_times(arrays["t_s"], offsets)
    columns: dict[str, list[Any]] = {}
    for name, array in arrays.items():
        axes = _ARRAYS[name].axes
        if axes.startswith("frames"):
            columns[name] = np.split(array, offsets[1:-1])
        elif axes.startswith("grasps"):
            columns[name] = array.tolist()
        if axes == "grasps" and array.dtype.kind == "U":
            for text in columns[name]:
                check_text(name, text)
        if name in _RECORDS:
            build = functools.cache(_RECORDS[name][1].from_values)  # a session shares a self-zero
            columns[name] = [
                None if all(map(math.isnan, row)) else build(tuple(row)) for row in columns[name]
            ]
    return tuple(
        Grasp(pads=pads, **dict(zip(columns, values, strict=True)))
        for values in zip(*columns.values(), strict=True)
    )
