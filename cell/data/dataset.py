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
thickness_mm   float32 (n_grasps,)         of the object along the closing axis by its drawing;
                                           NaN where unknown; optional
pose           float64 (n_grasps, 5)       commanded: ``recognition.grasp.COMMAND_COLUMNS``;
                                           a row of NaN where unknown; optional
self_zero      float64 (n_grasps, 8)       self-zero of the empty fingers before:
                                           ``recognition.grasp.ZERO_COLUMNS``; a row of NaN where
                                           it was not measured; optional
============== =========================== ======================================================
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cell.data.files import read_npz, savez, write_atomically
from cell.data.formats import DATASET
from cell.data.grasp_limits import (
    MAX_TEXT,
    RANGES,
    beyond_range,
    openings_too_small,
    pads_too_small,
    text_refused,
    times_refused,
)
from cell.errors import DatasetError
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

_REQUIRED = (
    "format",
    "adc_max",
    "pad_shape",
    "taxel_pad",
    "taxel_xy_mm",
    "counts",
    "aperture_mm",
    "t_s",
    "grasp_offsets",
    "label",
    "start_ms",
)
_OPTIONAL = ("force_n", "shape", "source", "thickness_mm", "pose", "self_zero")
_MAX_TAXELS = 1 << 16
"""Most taxels of a grasp, far more than any sensor here has."""


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
    return _Checker(path, arrays).grasps()


def read_grasps(path: Path | str) -> tuple[Grasp, ...]:
    """Read the grasps of a data set, or of a recording if the file is an ``.mcap``.

    Raises DatasetError or cell.errors.RecordingError if the file cannot be read, or has no whole
    grasp.
    """
    path = Path(path)
    if path.suffix != ".mcap":
        return read_dataset(path)
    from cell.data.recording_reader import recording_grasps  # noqa: PLC0415  slow to load

    grasps = recording_grasps(path)
    if not grasps:
        raise DatasetError(f"{path} has no whole grasp")
    return tuple(grasps)


def write_dataset(path: Path | str, grasps: Sequence[Grasp]) -> None:
    """Write grasps as one data set, whole or not at all; an older file stays until then.

    Raises DatasetError if there is no grasp, the pads differ, a text cannot be stored, or the write
    fails.
    """
    path = Path(path)
    if not grasps:
        raise DatasetError(f"cannot write data set {path}: there is no grasp to write")
    arrays = _arrays_of(path, grasps)
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
        for name in ("label", "shape", "source"):
            if wrong := text_refused(name, getattr(grasp, name)):
                raise DatasetError(f"cannot write data set {path}: {name} of grasp {i} {wrong}")
    arrays: dict[str, NDArray[Any]] = {
        "format": np.array(str(DATASET)),
        "adc_max": np.array(pads.adc_max, dtype=np.int64),
        "pad_shape": pads.pad_shape,
        "taxel_pad": pads.taxel_pad,
        "taxel_xy_mm": (pads.taxel_xy_m * 1e3).astype(np.float32),
        "counts": np.concatenate([grasp.counts for grasp in grasps]),
        "aperture_mm": np.concatenate([g.aperture_m * 1e3 for g in grasps]).astype(np.float32),
        "t_s": np.concatenate([grasp.t_s for grasp in grasps]).astype(np.float32),
        "grasp_offsets": np.cumsum([0, *(g.n_frames for g in grasps)], dtype=np.int64),
        "label": np.array([grasp.label for grasp in grasps], dtype=np.str_),
        "start_ms": np.array([grasp.start_ms for grasp in grasps], dtype=np.int64),
    }
    force_n = np.concatenate([grasp.force_n for grasp in grasps])
    thickness_mm = np.array([1e3 * grasp.thickness_m for grasp in grasps])
    for name, values in {"force_n": force_n, "thickness_mm": thickness_mm}.items():
        if not np.all(np.isnan(values)):
            arrays[name] = values.astype(np.float32)
    for name in ("shape", "source"):
        texts = [getattr(grasp, name) for grasp in grasps]
        if any(texts):
            arrays[name] = np.array(texts, dtype=np.str_)
    for name, columns, rows in (
        ("pose", COMMAND_COLUMNS, [grasp.command for grasp in grasps]),
        ("self_zero", ZERO_COLUMNS, [grasp.zero for grasp in grasps]),
    ):
        if any(rows):
            unknown = (np.nan,) * len(columns)
            arrays[name] = np.array([row.values if row else unknown for row in rows])
    for name in RANGES.keys() & arrays.keys():
        values = arrays[name][:, :2] if name == "pose" else arrays[name]
        if wrong := beyond_range(name, values):
            raise DatasetError(f"cannot write data set {path}: {name} {wrong}")
    return arrays


class _Checker:
    """Checks each array of one file before it is used."""

    def __init__(self, path: Path, arrays: dict[str, NDArray[Any]]) -> None:
        self._path = path
        self._arrays = arrays
        if "format" in arrays:
            DATASET.check(arrays["format"].tolist(), path, DatasetError)
        missing = [name for name in _REQUIRED if name not in arrays]
        if missing and "model" in arrays:
            raise DatasetError(f"{path} is a model: name the data sets that taught it")
        if missing:
            raise DatasetError(f"{path} is not a grasp data set: {', '.join(missing)} missing")
        unknown = [name for name in arrays if name not in _REQUIRED + _OPTIONAL]
        if unknown:
            raise DatasetError(f"{path}: unknown arrays {', '.join(map(repr, unknown))}")

    def _refuse(self, name: str, reason: str) -> DatasetError:
        return DatasetError(f"{self._path}, array {name}: {reason}")

    def _take(self, name: str, kinds: str, shape: tuple[int, ...]) -> NDArray[Any]:
        array = self._arrays[name]
        if array.dtype.kind not in kinds:
            raise self._refuse(name, f"has the type {array.dtype}, expected kind {kinds}")
        if array.shape != shape:
            raise self._refuse(name, f"has the shape {array.shape}, expected {shape}")
        return array

    def _ints(self, name: str, shape: tuple[int, ...]) -> NDArray[np.int64]:
        array = self._take(name, "iu", shape)
        if array.size and int(array.max()) > np.iinfo(np.int64).max:
            raise self._refuse(name, f"reaches {array.max()}, beyond 64 bits")
        return array.astype(np.int64)

    def _floats(self, name: str, shape: tuple[int, ...], *, nan: bool) -> NDArray[np.float64]:
        with np.errstate(invalid="ignore"):  # signalling NaN; checked below
            array = self._take(name, "f", shape).astype(np.float64)
        bad = np.isinf(array) if nan else ~np.isfinite(array)
        if np.any(bad):
            where = int(np.argmax(bad.ravel()))
            raise self._refuse(name, f"value {array.ravel()[where]} at {where} is not finite")
        return array

    def _in_range(self, name: str, shape: tuple[int, ...], *, nan: bool) -> NDArray[np.float64]:
        array = self._floats(name, shape, nan=nan)
        self._allow(name, beyond_range(name, array))
        return array

    def _known(self, name: str, n: int) -> NDArray[np.float64]:
        """Return an optional array of n numbers; NaN without the array."""
        return self._in_range(name, (n,), nan=True) if name in self._arrays else np.full(n, np.nan)

    def _allow(self, name: str, wrong: str | None) -> None:
        if wrong is not None:
            raise self._refuse(name, wrong)

    def _texts(self, name: str, n_grasps: int) -> list[str]:
        if name not in self._arrays:
            return [""] * n_grasps
        array = self._take(name, "U", (n_grasps,))
        if array.dtype.itemsize > 4 * MAX_TEXT:
            raise self._refuse(name, f"has texts of type {array.dtype}, limit {MAX_TEXT}")
        texts: list[str] = array.tolist()
        for i, text in enumerate(texts):
            if wrong := text_refused(name, text):
                raise self._refuse(name, f"of grasp {i} {wrong}")
        return texts

    def _rows(self, name: str, columns: Sequence[str], n_grasps: int) -> list[list[float] | None]:
        """Return an optional array with a row for each grasp; None for an unknown row."""
        if name not in self._arrays:
            return [None] * n_grasps
        rows = self._floats(name, (n_grasps, len(columns)), nan=True)
        if name in RANGES:
            self._allow(name, beyond_range(name, rows[:, :2]))
        unknown = np.isnan(rows)
        if np.any(unknown.any(axis=1) != unknown.all(axis=1)):
            raise self._refuse(name, "has a row with some NaN; write all its values, or only NaN")
        return [None if np.isnan(row[0]) else row.tolist() for row in rows]

    def _zeros(self, n_grasps: int) -> list[SelfZero | None]:
        """Return the self-zeros; grasps of one session share one."""
        known: dict[tuple[float, ...], SelfZero] = {}
        found: list[SelfZero | None] = []
        for row in self._rows("self_zero", ZERO_COLUMNS, n_grasps):
            try:
                zero = None if row is None else SelfZero.from_values(row)
            except ValueError as error:
                raise self._refuse("self_zero", str(error)) from error
            found.append(None if zero is None else known.setdefault(zero.values, zero))
        return found

    def _pads(self) -> PadArray:
        adc_max = int(self._ints("adc_max", ()))
        if not 1 <= adc_max <= np.iinfo(np.uint16).max:
            raise self._refuse("adc_max", f"is {adc_max}, must be from 1 to 65535")
        n_pads = self._arrays["pad_shape"].shape[0] if self._arrays["pad_shape"].ndim else 0
        pad_shape = self._ints("pad_shape", (n_pads, 2))
        if not n_pads or pad_shape.min() < 1 or pad_shape.max() > _MAX_TAXELS:
            raise self._refuse("pad_shape", f"needs rows and columns from 1 to {_MAX_TAXELS}")
        n_taxels = self._arrays["taxel_pad"].size
        if n_taxels > _MAX_TAXELS:
            raise self._refuse("taxel_pad", f"has {n_taxels} taxels, limit {_MAX_TAXELS}")
        taxel_pad = self._ints("taxel_pad", (n_taxels,))
        if not n_taxels or taxel_pad.min() < 0 or taxel_pad.max() >= n_pads:
            raise self._refuse("taxel_pad", f"must name pads from 0 to {n_pads - 1}")
        xy_m = self._in_range("taxel_xy_mm", (n_taxels, 2), nan=False) * 1e-3
        try:
            pads = PadArray(
                pad_shape=pad_shape, taxel_pad=taxel_pad, taxel_xy_m=xy_m, adc_max=adc_max
            )
        except ValueError as cause:
            raise self._refuse("taxel_pad", str(cause)) from cause
        self._allow("taxel_xy_mm", pads_too_small(pads))
        return pads

    def _offsets(self, n_frames: int) -> NDArray[np.int64]:
        size = self._arrays["grasp_offsets"].size
        offsets = self._ints("grasp_offsets", (size,))
        if size < 2 or offsets[0] != 0 or offsets[-1] != n_frames:
            raise self._refuse("grasp_offsets", f"must run from 0 to the {n_frames} frames")
        if np.any(offsets[1:] <= offsets[:-1]):
            raise self._refuse("grasp_offsets", "must rise: each grasp has at least one frame")
        return offsets

    def grasps(self) -> tuple[Grasp, ...]:
        pads = self._pads()
        counts = self._arrays["counts"]
        n_frames = counts.shape[0] if counts.ndim else 0
        if counts.dtype != np.uint16:
            raise self._refuse("counts", f"has the type {counts.dtype}, expected uint16")
        counts = self._take("counts", "u", (n_frames, pads.n_taxels))
        if n_frames and int(counts.max()) > pads.adc_max:
            raise self._refuse("counts", f"reach {counts.max()}, adc_max is {pads.adc_max}")
        offsets = self._offsets(n_frames)
        n_grasps = len(offsets) - 1
        t_s = self._floats("t_s", (n_frames,), nan=False)
        self._allow("t_s", times_refused(t_s, offsets))
        aperture_mm = self._in_range("aperture_mm", (n_frames,), nan=True)
        self._allow("aperture_mm", openings_too_small(aperture_mm))
        aperture_m = aperture_mm * 1e-3
        force_n = self._known("force_n", n_frames)
        thickness_m = 1e-3 * self._known("thickness_mm", n_grasps)
        start_ms = self._ints("start_ms", (n_grasps,))
        self._allow("start_ms", beyond_range("start_ms", start_ms))
        texts = [self._texts(name, n_grasps) for name in ("label", "shape", "source")]
        placings = self._rows("pose", COMMAND_COLUMNS, n_grasps)
        zeros = self._zeros(n_grasps)
        return tuple(
            Grasp(
                pads=pads,
                counts=counts[first:last],
                t_s=t_s[first:last],
                aperture_m=aperture_m[first:last],
                force_n=force_n[first:last],
                label=texts[0][i],
                shape=texts[1][i],
                source=texts[2][i],
                start_ms=int(start_ms[i]),
                thickness_m=float(thickness_m[i]),
                command=None if (asked := placings[i]) is None else GraspCommand.from_values(asked),
                zero=zeros[i],
            )
            for i, (first, last) in enumerate(itertools.pairwise(offsets))
        )
