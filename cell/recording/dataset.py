"""Grasp data sets: the format ``grasp-dataset/1``, an npz archive without pickled objects.

============== =========================== ======================================================
array          dtype, shape                meaning
============== =========================== ======================================================
format         str                         ``grasp-dataset/1``
adc_max        int                         full scale of ``counts``
pad_shape      int (n_pads, 2)             rows, columns of each pad
taxel_pad      int (n_taxels,)             pad of each taxel; row-major within a pad
taxel_xy_mm    float32 (n_taxels, 2)       x along the finger, y across, in mm
counts         uint16 (n_frames, n_taxels) raw frames of all grasps, one after the other
aperture_mm    float32 (n_frames,)         opening between the fingers in mm; NaN where unknown
force_n        float32 (n_frames,)         commanded grip force in N; NaN where unknown; optional
t_s            float32 (n_frames,)         time since the grasp's first frame in s
grasp_offsets  int64 (n_grasps + 1,)       grasp i has the frames offsets[i] to offsets[i + 1]
label          str (n_grasps,)             grasped object; empty where unknown
shape          str (n_grasps,)             class of shape; optional
start_ms       int64 (n_grasps,)           time of the grasp's first frame
source         str (n_grasps,)             its origin; optional
series         str (n_grasps,)             individual or day; optional. Where it is empty, a pause
                                           of an hour begins a new series
thickness_mm   float32 (n_grasps,)         of the object along the closing axis by its drawing;
                                           NaN where unknown; optional
pose           float64 (n_grasps, 5)       commanded: ``recognition.grasp.COMMAND_COLUMNS``;
                                           a row of NaN where unknown; optional
self_zero      float64 (n_grasps, 8)       self-zero of the empty fingers before:
                                           ``recognition.grasp.ZERO_COLUMNS``; a row of NaN where
                                           it was not measured; optional
============== =========================== ======================================================
"""

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.errors import DatasetError, raised_as
from cell.files import read_npz, savez, write_atomically
from cell.formats import DATASET
from cell.recording.grasp_limits import (
    RANGES,
    beyond_range,
    openings_too_small,
    pads_too_small,
    text_refused,
    times_refused,
)
from recognition.grasp import (
    COMMAND_COLUMNS,
    ZERO_COLUMNS,
    Grasp,
    GraspCommand,
    PadArray,
    SelfZero,
)

DATASET_LIMIT_BYTES = 1 << 30
"""Default limit of the unpacked size of a data set in bytes."""

_ARRAYS = {
    "format": ("U", ""),
    "adc_max": ("iu", ""),
    "pad_shape": ("iu", "pads xy"),
    "taxel_pad": ("iu", "taxels"),
    "taxel_xy_mm": ("f", "taxels xy"),
    "counts": ("u", "frames taxels"),
    "aperture_mm": ("f", "frames"),
    "t_s": ("f", "frames"),
    "grasp_offsets": ("iu", "offsets"),
    "label": ("U", "grasps"),
    "start_ms": ("iu", "grasps"),
    "force_n": ("f", "frames"),
    "shape": ("U", "grasps"),
    "source": ("U", "grasps"),
    "series": ("U", "grasps"),
    "thickness_mm": ("f", "grasps"),
    "pose": ("f", "grasps command"),
    "self_zero": ("f", "grasps zero"),
}
"""Kinds of the numpy type of each array, and its axes; arrays with the same axis have the same
length along it."""
_OF_FRAMES = {"t_s": ("t_s", 1.0), "aperture_mm": ("aperture_m", 1e-3), "force_n": ("force_n", 1.0)}
"""Field of a grasp, and unit, of each array of frames."""
_TEXTS = ("label", "shape", "source", "series")
_RECORDS: Mapping[str, tuple[str, tuple[str, ...], Any]] = {
    "pose": ("command", COMMAND_COLUMNS, GraspCommand),
    "self_zero": ("zero", ZERO_COLUMNS, SelfZero),
}
"""Field of a grasp, its numbers and its kind, of each array of such rows."""
_AXES = {"xy": 2, "command": len(COMMAND_COLUMNS), "zero": len(ZERO_COLUMNS)}
"""Length of the axes that are the same in all data sets."""
_OPTIONAL = {"force_n", "shape", "source", "series", "thickness_mm", "pose", "self_zero"}


def read_dataset(path: Path | str, *, limit_bytes: int = DATASET_LIMIT_BYTES) -> tuple[Grasp, ...]:
    """Read all grasps of a data set that unpacks to at most ``limit_bytes`` bytes.

    They share one `PadArray` object.

    Raises
    ------
    DatasetError
        Naming the file, the array, the value and the limit.
    """
    path = Path(path)
    arrays = read_npz(path, error=DatasetError, what="grasp data set", limit_bytes=limit_bytes)
    if "format" in arrays:
        DATASET.check(str(arrays["format"]), path, DatasetError)
    missing = [name for name in _ARRAYS if name not in arrays and name not in _OPTIONAL]
    if missing and "model" in arrays:
        raise DatasetError(f"{path} is a model: name the data sets that taught it")
    if missing:
        raise DatasetError(f"{path} is not a grasp data set: {', '.join(missing)} missing")
    if unknown := [name for name in arrays if name not in _ARRAYS]:
        raise DatasetError(f"{path}: unknown arrays {', '.join(map(repr, unknown))}")
    # A signalling NaN, or differences of infinite times; both are refused.
    with raised_as(DatasetError, ValueError, where=str(path)), np.errstate(invalid="ignore"):
        _check_arrays(arrays)
        return _grasps_of(arrays)


def read_grasps(path: Path | str) -> tuple[Grasp, ...]:
    """Read the grasps of a data set, or of a recording if the file is an ``.mcap``.

    Raises DatasetError or cell.errors.RecordingError if the file cannot be read, or has no whole
    grasp.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        return read_dataset(path)
    from cell.recording.reader import recording_grasps  # noqa: PLC0415  slow to load

    return recording_grasps(path)


def write_dataset(path: Path | str, grasps: Sequence[Grasp]) -> None:
    """Write grasps as one data set, whole or not at all; an older file stays until then.

    Raises DatasetError if there is no grasp, the pads differ, a text cannot be stored, or the write
    fails.
    """
    path = Path(path)
    if not grasps:
        raise DatasetError(f"cannot write data set {path}: there is no grasp to write")
    arrays = _arrays_of(path, grasps)
    with raised_as(DatasetError, ValueError, where=f"cannot write data set {path}"):
        _check_arrays(arrays)
        _grasps_of(arrays)
    write_atomically(
        path, lambda file: savez(file, arrays), error=DatasetError, what="grasp data set"
    )


def _arrays_of(path: Path, grasps: Sequence[Grasp]) -> dict[str, NDArray[Any]]:
    pads = grasps[0].pads
    for i, grasp in enumerate(grasps):
        if grasp.pads is not pads and not grasp.pads.same_as(pads):
            raise DatasetError(
                f"cannot write data set {path}: grasp {i} was taken on other pads than grasp 0; "
                "write one data set for each kind of pads"
            )
        for name in _TEXTS:  # an array loses a zero at the end of a text
            if wrong := text_refused(name, getattr(grasp, name)):
                raise DatasetError(f"cannot write data set {path}: {name} of grasp {i} {wrong}")
    arrays: dict[str, NDArray[Any]] = {
        "format": np.array(str(DATASET)),
        "adc_max": np.array(pads.adc_max, dtype=np.int64),
        "pad_shape": pads.pad_shape,
        "taxel_pad": pads.taxel_pad,
        "taxel_xy_mm": (pads.taxel_xy_m * 1e3).astype(np.float32),
        "counts": np.concatenate([grasp.counts for grasp in grasps]),
        "grasp_offsets": np.cumsum([0, *(g.n_frames for g in grasps)], dtype=np.int64),
        "start_ms": np.array([grasp.start_ms for grasp in grasps], dtype=np.int64),
        "thickness_mm": np.array([grasp.thickness_m * 1e3 for grasp in grasps], dtype=np.float32),
    }
    for name, (field, unit) in _OF_FRAMES.items():
        values = np.concatenate([getattr(grasp, field) for grasp in grasps])
        arrays[name] = (values / unit).astype(np.float32)
    for name in _TEXTS:
        arrays[name] = np.array([getattr(grasp, name) for grasp in grasps], dtype=np.str_)
    for name, (field, columns, _) in _RECORDS.items():
        rows = [getattr(grasp, field) for grasp in grasps]
        unknown = (np.nan,) * len(columns)
        arrays[name] = np.array([row.values if row else unknown for row in rows])

    def known(values: NDArray[Any]) -> bool:
        return bool(
            np.any(values != "") if values.dtype.kind == "U" else not np.isnan(values).all()
        )

    return {name: one for name, one in arrays.items() if name not in _OPTIONAL or known(one)}


def _check_arrays(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Raise ValueError for an array of another type or shape, or with a number beyond its range."""
    lengths: dict[str, int] = dict(_AXES)
    for name, (kinds, axes) in _ARRAYS.items():
        if name not in arrays:
            continue
        array = arrays[name]
        for axis, length in zip(axes.split(), array.shape, strict=False):
            lengths.setdefault(axis, length)
        expected = tuple(lengths.get(axis) for axis in axes.split())
        if array.dtype.kind not in kinds or array.shape != expected:
            raise ValueError(
                f"array {name} has the type {array.dtype} and the shape {array.shape}, expected "
                f"kind {kinds} and shape {expected}"
            )
        if name in RANGES:
            _allow(name, beyond_range(name, array[:, :2] if name == "pose" else array))


def _allow(name: str, wrong: str | None) -> None:
    if wrong is not None:
        raise ValueError(f"array {name} {wrong}")


def _grasps_of(arrays: Mapping[str, NDArray[Any]]) -> tuple[Grasp, ...]:
    """Return the grasps. Raises ValueError if the arrays do not fit each other."""
    pads = PadArray(
        pad_shape=arrays["pad_shape"],
        taxel_pad=arrays["taxel_pad"],
        taxel_xy_m=1e-3 * arrays["taxel_xy_mm"].astype(np.float64),
        adc_max=int(arrays["adc_max"]),
    )
    _allow("taxel_xy_mm", pads_too_small(pads))
    offsets = arrays["grasp_offsets"].astype(np.int64)
    n_frames, n_grasps = len(arrays["counts"]), len(arrays["label"])
    if (
        (n_grasps < 1 or len(offsets) != n_grasps + 1)
        or (offsets[0] != 0 or offsets[-1] != n_frames)
        or np.any(offsets[1:] <= offsets[:-1])
    ):
        raise ValueError(
            f"array grasp_offsets must have {n_grasps + 1} numbers for {n_grasps} grasps, which "
            f"rise from 0 to the {n_frames} frames"
        )
    of_frames: dict[str, Any] = {"counts": arrays["counts"]}
    for name, (field, unit) in _OF_FRAMES.items():
        if name in arrays:
            of_frames[field] = unit * arrays[name].astype(np.float64)
    _allow("t_s", times_refused(of_frames["t_s"], offsets))
    _allow("aperture_mm", openings_too_small(arrays["aperture_mm"]))
    of_grasps: dict[str, Any] = {"start_ms": arrays["start_ms"].tolist()}
    if "thickness_mm" in arrays:
        of_grasps["thickness_m"] = (1e-3 * arrays["thickness_mm"].astype(np.float64)).tolist()
    for name in [name for name in _TEXTS if name in arrays]:
        of_grasps[name] = arrays[name].tolist()
        for i, text in enumerate(of_grasps[name]):
            _allow(f"{name} of grasp {i}", text_refused(name, text))
    for name, (field, _, kind) in _RECORDS.items():
        build = functools.cache(kind.from_values)  # a session shares one self-zero
        if name in arrays:
            of_grasps[field] = [
                None if all(map(math.isnan, row)) else build(tuple(row))
                for row in arrays[name].tolist()
            ]
    return tuple(
        Grasp(
            pads=pads,
            **{name: values[first:last] for name, values in of_frames.items()},
            **{name: values[i] for name, values in of_grasps.items()},
        )
        for i, (first, last) in enumerate(itertools.pairwise(offsets))
    )
