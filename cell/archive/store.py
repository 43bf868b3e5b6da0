"""Archive: rows made of grasps in Parquet files by cell and day, in a folder or a store of fsspec.

Workers stage the rows of a source as whole files. One writer moves them to their place, so a reader
never sees a half file. `_sources` has a note for each file in the archive; it is written last. So
the next run after a kill reads that file again, and the rows that are there are known by their key.
"""

import hashlib
import json
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import fsspec
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from cell.archive.selection import EVERYTHING, HEAD, Selection, cell_of, day_of, of_cell
from cell.errors import ArchiveError, CellError
from cell.files import ARCHIVE
from cell.recording.reader import Recording, between
from gripper.values.state import GripperPhase
from recognition.features import FEATURE_VERSION, features_of, sizes_mm
from recognition.grasp import COMMAND_COLUMNS, ZERO_COLUMNS, Grasp, GraspCommand, PadArray, SelfZero
from recognition.ramp.ramp import Rest, learn_rest, load_levels

_BEFORE_S = 3.0
"""Time in s before the first frame of a grasp in which its fingers close."""
GROUP = 64
"""Rows in a piece of the table."""
_NAME_BYTES = 255
"""Longest name of a folder in bytes (NAME_MAX of Linux)."""

_NUMBER, _TEXT = pa.float64(), pa.string()
_PLAIN = ("label", "shape", "source", "series", "start_ms")
"""Columns with a text or a number of the grasp."""
_OF_FRAMES = ("t_s", "aperture_m", "force_n")
"""Columns with a number for each frame."""
_COLUMNS: tuple[tuple[str, Any, str], ...] = (
    ("key", _TEXT, "SHA-256 of start and counts, 32 digits; one grasp has one key in all files"),
    ("recording", _TEXT, "path of the recording or data set"),
    ("recording_sha256", _TEXT, "checksum of that file"),
    ("grasp", pa.int32(), "number of the grasp in that file, from 0"),
    ("part", pa.int32(), "number of its identification in the recording; null for taught ones"),
    ("of_part", pa.int32(), "number of the grasp in its identification, from 0"),
    ("part_grasps", pa.int32(), "grasps of that identification"),
    ("start_ms", pa.int64(), "wall clock of the first frame, ms since 1970"),
    ("source", _TEXT, "where the grasp came from, `cell NAME` for a cell"),
    ("label", _TEXT, "what was grasped, as taught or as the host named it; empty where unknown"),
    ("taught", pa.bool_(), "whether the grasp was taken to teach"),
    ("answer", _TEXT, "answer to all grasps of the part: a taught label, or UNKNOWN"),
    ("answer_probability", _NUMBER, "its probability"),
    ("answer_unknown", _NUMBER, "probability that the part was never taught"),
    ("probabilities", pa.map_(_TEXT, _NUMBER), "of each label by this grasp by itself"),
    ("unknown", _NUMBER, "probability by this grasp that the object was never taught"),
    ("series", _TEXT, "individual or day; empty where it was not named"),
    ("shape", _TEXT, "class of shape that was asked for"),
    ("shape_kind", _TEXT, "kind of shape by this grasp"),
    ("size_m", _NUMBER, "thickness along the closing axis by this grasp, m"),
    ("size_low_m", _NUMBER, "lower end of its interval of 90 %, m"),
    ("size_high_m", _NUMBER, "upper end, m"),
    ("thickness_m", _NUMBER, "thickness by the drawing, m"),
    ("drift_gain", _NUMBER, "gain of the pads since teaching that the answer rests on"),
    ("drift_aperture_m", _NUMBER, "offset of the opening that it rests on, m"),
    ("command", pa.struct([(name, _NUMBER) for name in COMMAND_COLUMNS]), "pose and force"),
    ("zero", pa.struct([(name, _NUMBER) for name in ZERO_COLUMNS]), "self-zero before the grasp"),
    ("closing_current_a", _NUMBER, "median current of the closing, empty fingers, A: friction"),
    ("hold_current_a", _NUMBER, "mean current in the last tenth of the ramp, A"),
    ("hold_force_n", _NUMBER, "mean tactile force of both fingers there, N"),
    ("temperature_c", _NUMBER, "warmest servo at the end, degrees Celsius"),
    ("touch_aperture_m", _NUMBER, "opening where both pads first touch, m"),
    ("pad_load", pa.list_(_NUMBER), "rise of each pad under full load, in full scales of a taxel"),
    ("features", pa.list_(pa.float32()), "of the default recognizer; null without touch"),
    ("feature_version", pa.int32(), "version of these features"),
    ("pads", _TEXT, "places of the taxels and full scale of the counts, JSON"),
    ("t_s", pa.list_(_NUMBER), "time of each frame since the first, s"),
    ("aperture_m", pa.list_(_NUMBER), "opening in each frame, m; NaN where unknown"),
    ("force_n", pa.list_(_NUMBER), "commanded grip force in each frame, N; NaN where unknown"),
    ("counts", pa.list_(pa.list_(pa.uint16())), "raw counts of each frame"),
)  # fmt: skip
COLUMNS: Mapping[str, str] = {name: text for name, _, text in _COLUMNS}
"""Columns of the table and their meaning; `cell` and `day` are partitions."""
SCHEMA = pa.schema(
    [pa.field(name, kind) for name, kind, _ in _COLUMNS], metadata={"format": str(ARCHIVE)}
)
"""Schema of the Parquet files."""
_BY = pa.schema([("cell", _TEXT), ("day", _TEXT)])
PARTITION = ds.partitioning(_BY, flavor="hive")
"""Folders of the Parquet files, such as ``cell=press/day=2027-01-04``."""
TABLE = pa.schema([*SCHEMA, *_BY])
"""Columns of the files and of their folders."""


def grasp_key(grasp: Grasp) -> str:
    """Return the key of a grasp; it is equal for the same grasp in several files."""
    digest = hashlib.sha256(f"{grasp.start_ms}|{grasp.counts.shape}|".encode())
    digest.update(np.asarray(grasp.counts, dtype="<u2").tobytes())
    return digest.hexdigest()[:32]


Row = tuple[Grasp, dict[str, Any]]
"""A grasp and the further columns of its row."""


def recording_rows(recording: Recording, cell: str = "") -> list[Row]:
    """Return the rows of a recording, each with its answer and the values of the servos."""
    cell = recording.metadata.get("cell", "") or cell
    answered = _answers(recording)
    return [
        (
            of_cell(grasp, cell),
            {"grasp": number} | _servos(recording, grasp, t_s) | answered.get(i, {}),
        )
        for i, (grasp, number, t_s) in enumerate(
            zip(recording.grasps, recording.grasp_numbers, recording.grasp_t_s, strict=True)
        )
    ]


_OF_RESULT = {
    "part_grasps": "n_grasps",
    "answer": "label",
    "answer_probability": "probability",
    "answer_unknown": "unknown",
    "drift_gain": "drift_gain",
    "drift_aperture_m": "drift_aperture_m",
}
_OF_SHAPE = {
    "shape_kind": "kind", "size_m": "size_m", "size_low_m": "low_m", "size_high_m": "high_m",
}  # fmt: skip
"""Columns by their names in a recorded answer, and in its shape."""


def _answers(recording: Recording) -> dict[int, dict[str, Any]]:
    """Return the columns of the identifications, by the index of the grasp in the recording."""
    columns: dict[int, dict[str, Any]] = {}
    for part, (row, met) in enumerate(recording.identified):
        singles, shapes = row.get("grasp_answers", []), row.get("grasp_shapes", [])
        common = {"part": part} | {name: row.get(key) for name, key in _OF_RESULT.items()}
        if row.get("held"):
            common["label"] = row["held"]
        for place, i in enumerate(met):
            shape = shapes[place] if len(shapes) == len(met) else row.get("shape", {})
            values = {name: shape.get(key) for name, key in _OF_SHAPE.items()}
            if len(singles) == len(met):
                chances = singles[place].get("probabilities", [])
                values["probabilities"] = list(zip(row["labels"], chances, strict=False))
                values["unknown"] = singles[place].get("unknown")
            columns[i] = common | {"of_part": place} | values
    return columns


def _servos(recording: Recording, grasp: Grasp, t_s: float) -> dict[str, Any]:
    """Return the servo values before and at the end of a grasp; empty without a period."""
    length_s = float(grasp.t_s[-1])
    closing = between(recording.cycles, t_s - _BEFORE_S, t_s + length_s)
    holding = between(recording.cycles, t_s + 0.9 * length_s, t_s + length_s)
    values = {}
    moving = closing.phase == GripperPhase.APPROACHING.name
    if moving.any():
        values["closing_current_a"] = float(np.nanmedian(np.abs(closing.current_a[moving])))
    if len(holding):
        means = {"hold_current_a": np.abs(holding.current_a), "hold_force_n": holding.force_n}
        values |= {
            n: float(v[np.isfinite(v)].mean()) for n, v in means.items() if np.isfinite(v).any()
        }
        values["temperature_c"] = float(holding.temperature_c[-1])
    return values


def batches(rows: Sequence[Row], recording: str, sha256: str) -> Iterator[pa.RecordBatch]:
    """Yield the rows of a file, which share their pads, in pieces with the columns of `TABLE`.

    Raises CellError for a cell whose folder cannot be made.
    """
    try:
        rest = learn_rest([grasp for grasp, _ in rows])
    except ValueError:  # ramps that are too short have no features
        rest = None
    for start in range(0, len(rows), GROUP):
        part = rows[start : start + GROUP]
        grasps = [grasp for grasp, _ in part]
        values = [
            {"recording": recording, "recording_sha256": sha256}
            | _plain(grasp)
            | described
            | further
            for (grasp, further), described in zip(part, _described(grasps, rest), strict=True)
        ]
        yield pa.RecordBatch.from_arrays(
            [pa.array([_finite(row.get(key.name)) for row in values], key.type) for key in TABLE],
            schema=TABLE,
        )


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _plain(grasp: Grasp) -> dict[str, Any]:
    cell = cell_of(grasp)
    n_bytes = len(quote(cell)) + len("cell=")
    if n_bytes > _NAME_BYTES:
        raise CellError(
            f"its cell {cell!r:.40} makes a folder name of {n_bytes} bytes, at most {_NAME_BYTES} "
            "are possible: give the cell a shorter name"
        )
    return {
        "cell": cell,
        "day": day_of(grasp.start_ms),
        "pads": _pads_text(grasp.pads),
        "key": grasp_key(grasp),
        "taught": bool(grasp.label),
        "thickness_m": grasp.thickness_m,
        "counts": list(grasp.counts),
        **{name: getattr(grasp, name) for name in (*_PLAIN, *_OF_FRAMES)},
        "command": grasp.command and asdict(grasp.command),
        "zero": grasp.zero and asdict(grasp.zero),
    }


def _described(grasps: Sequence[Grasp], rest: Rest | None) -> list[dict[str, Any]]:
    """Return the features of each grasp; empty for one that is too short or not touched.

    All together take a tenth of the time of single ones.
    """
    try:
        levels = load_levels(grasps, rest) if rest is not None else None
    except ValueError:
        if len(grasps) > 1:
            return [values for grasp in grasps for values in _described([grasp], rest)]
        levels = None
    described: list[dict[str, Any]] = [{} for _ in grasps]
    if rest is None or levels is None or not levels.touched.any():
        return described
    places, levels = np.flatnonzero(levels.touched), levels.take(levels.touched)
    features = features_of(levels, rest, opening=True)
    loads = np.stack([maps[:, -1].sum(axis=1) for maps in levels.maps], axis=1)
    for row, place in enumerate(places.tolist()):
        described[place] = {
            "touch_aperture_m": 1e-3 * float(sizes_mm(levels)[row, 1]),
            "pad_load": loads[row].tolist(),
            "features": features[row].astype(np.float32),
            "feature_version": FEATURE_VERSION,
        }
    return described


@lru_cache(maxsize=16)
def _pads_text(pads: PadArray) -> str:
    return json.dumps({name: array.tolist() for name, array in pads.to_arrays().items()})


@lru_cache(maxsize=16)
def _pads(text: str) -> PadArray:
    return PadArray.from_arrays({name: np.array(v) for name, v in json.loads(text).items()})


def grasps_of(batch: pa.RecordBatch) -> Iterator[Grasp]:
    """Yield the grasps of rows, as they were archived."""
    single = [*_PLAIN, "thickness_m", "command", "zero", "pads"]
    for i, row in enumerate(batch.select(single).to_pylist()):
        pads = _pads(row["pads"])
        lists = {name: batch[name].slice(i, 1).flatten() for name in (*_OF_FRAMES, "counts")}
        yield Grasp(
            pads=pads,
            counts=lists.pop("counts").flatten().to_numpy().reshape(-1, pads.n_taxels),
            **{name: values.to_numpy() for name, values in lists.items()},
            **{name: row[name] for name in _PLAIN},
            thickness_m=np.nan if row["thickness_m"] is None else row["thickness_m"],
            command=row["command"] and GraspCommand(**row["command"]),
            zero=row["zero"] and SelfZero(**row["zero"]),
        )


BUSY = "another program adds to this archive; run it again when that has ended"
_WHOLE = "whole"
"""File beside the staged rows of a source that are all there."""
SOURCES, STAGED = "_sources", "_staged"
"""Folders of the notes, and of staged files; readers of Parquet skip them."""
MOST_PARTITIONS = 1 << 20
"""Most days of cells in one source; pyarrow stops at 1024 of its own accord."""
_CACHED_DAYS = 32
"""Days of cells whose keys are kept while grasps are added."""


class Archive:
    """An archive of grasps.

    Parameters
    ----------
    target
        Its folder or URL.
    create
        Create it where it does not exist.

    Raises
    ------
    ArchiveError
        There is no archive, it has another format, or its place cannot be reached.
    """

    def __init__(self, target: str, *, create: bool = False) -> None:
        self.target = target
        with _named(target):
            self._fs, root = fsspec.core.url_to_fs(target)
            self._fs.invalidate_cache()  # other programs write, too
            self._root = root.rstrip("/")
            head = f"{self._root}/{HEAD}"
            if self._fs.exists(head):
                ARCHIVE.read(self._fs.cat_file(head), target, ArchiveError)
            elif not create:
                raise ArchiveError(
                    f"{target} is not an archive; `tactile-cell archive add RECORDINGS --to "
                    f"{target}` makes one"
                )
            else:
                staged = f"{self._root}/{STAGED}/{HEAD}"
                self._fs.makedirs(f"{self._root}/{STAGED}", exist_ok=True)
                self._fs.pipe_file(staged, json.dumps({"format": str(ARCHIVE)}).encode())
                self._fs.mv(staged, head)
        self.folder = Path(self._root) if "file" in self._fs.protocol else None
        """Its folder on this machine; None elsewhere."""
        self._keys = lru_cache(_CACHED_DAYS)(self._keys_in)

    # Reading

    def batches(
        self,
        columns: Sequence[str],
        selection: Selection = EVERYTHING,
        keys: Set[str] | None = None,
    ) -> Iterator[pa.RecordBatch]:
        """Yield some columns of the selected rows in pieces, by cell, day and file.

        `cell` and `day` are columns, too. With ``keys``, the rows of others are left out.
        """
        where = _filter(selection)
        if keys is not None:
            where &= pc.field("key").isin(pa.array(sorted(keys), pa.string()))
        with _named(self.target):
            rows = ds.dataset(
                self._root, TABLE, format="parquet", filesystem=self._fs, partitioning=PARTITION
            )
            files = sorted(rows.get_fragments(where), key=lambda file: file.path)
        for file in files:
            with _readable(file.path):
                yield from file.to_batches(
                    TABLE, columns=list(columns), filter=where, batch_size=GROUP
                )

    def table(self, columns: Sequence[str], selection: Selection = EVERYTHING) -> pa.Table:
        """Return some columns of the selected rows."""
        schema = pa.schema([TABLE.field(name) for name in columns])
        return pa.Table.from_batches(self.batches(columns, selection), schema)

    def grasps(
        self, selection: Selection = EVERYTHING, *, most: int | None = None
    ) -> Iterator[Grasp]:
        """Yield the selected grasps by cell, day and file; with ``most`` only labelled ones.

        Parameters
        ----------
        most
            Most grasps of each label. Those with the smallest keys are taken: a random but
            repeatable choice.
        """
        chosen = None if most is None else self._sample(selection, most)
        for rows in self.batches(SCHEMA.names, selection, chosen):
            yield from grasps_of(rows)

    def _sample(self, selection: Selection, most: int) -> set[str]:
        """Return the smallest keys of each label."""
        rows, n, chosen = self.table(["key", "label"], selection), Counter[str](), set[str]()
        for row in rows.sort_by("key").to_pylist():
            n[row["label"]] += 1
            if row["label"] and n[row["label"]] <= most:
                chosen.add(row["key"])
        return chosen

    # Writing

    def has_source(self, sha256: str) -> bool:
        """Return whether a file of this checksum is in the archive."""
        with _named(self.target):
            return bool(self._fs.exists(self._note(sha256)))

    def stage(self, sha256: str, rows: Iterable[pa.RecordBatch]) -> str:
        """Write the rows of a source beside the archive; return the name for `add`."""
        name = f"{sha256[:32]}-{secrets.token_hex(4)}"  # two workers may read two copies of a file
        with _named(self.target):
            ds.write_dataset(
                rows,
                f"{self._root}/{STAGED}/{name}",
                schema=TABLE,
                format="parquet",
                filesystem=self._fs,
                partitioning=PARTITION,
                basename_template=f"{name}-{{i}}.parquet",
                max_partitions=MOST_PARTITIONS,
                max_rows_per_group=GROUP,
                file_options=ds.ParquetFileFormat().make_write_options(compression="zstd"),
                preserve_order=True,
            )
            self._fs.makedirs(f"{self._root}/{STAGED}/{name}", exist_ok=True)
            self._fs.pipe_file(f"{self._root}/{STAGED}/{name}/{_WHOLE}", b"")
        return name

    def add(self, sha256: str, source: str, staged: str) -> tuple[int, int]:
        """Move staged files to their place; return the number of new and of known grasps.

        One program at a time may add to an archive. Raises ArchiveError if another one has removed
        the staged files.
        """
        new = known = 0
        with _named(self.target):
            self._fs.invalidate_cache()  # a worker has written the files
            files = self._fs.find(f"{self._root}/{STAGED}/{staged}")
            parts = [path for path in files if not path.endswith(_WHOLE)]
            if len(parts) == len(files):
                raise ArchiveError(BUSY)
            for path in parts:
                folder, _, name = path.rpartition(f"/{staged}/")[2].rpartition("/")
                there = self._keys(folder)
                with self._fs.open(path, "rb") as file, pq.ParquetFile(file) as rows:
                    keys = rows.read(["key"])["key"].to_pylist()
                    fresh = {key: i for i, key in reversed([*enumerate(keys)]) if key not in there}
                    table = rows.read() if len(fresh) < len(keys) else None
                if table is not None and fresh:
                    table = table.take(sorted(fresh.values()))
                    with self._fs.open(path, "wb") as file:
                        pq.write_table(table, file, compression="zstd", row_group_size=GROUP)
                if fresh:
                    self._fs.makedirs(f"{self._root}/{folder}", exist_ok=True)
                    self._fs.mv(path, f"{self._root}/{folder}/{name}")
                there.update(fresh)
                new, known = new + len(fresh), known + len(keys) - len(fresh)
            note = {"source": source, "sha256": sha256, "grasps": new, "before": known}
            self._fs.makedirs(f"{self._root}/{SOURCES}", exist_ok=True)
            self._fs.pipe_file(self._note(sha256), json.dumps(note).encode())
        return new, known

    def clear_staged(self) -> None:
        """Remove files that an interrupted program left beside the archive."""
        with _named(self.target):
            if self._fs.exists(f"{self._root}/{STAGED}"):
                self._fs.rm(f"{self._root}/{STAGED}", recursive=True)

    def _note(self, sha256: str) -> str:
        return f"{self._root}/{SOURCES}/{sha256}.json"

    def _keys_in(self, folder: str) -> set[str]:
        """Return the keys of a cell and day."""
        keys = set[str]()
        for path in self._fs.find(f"{self._root}/{folder}"):
            with _readable(path), self._fs.open(path, "rb") as file, pq.ParquetFile(file) as rows:
                keys.update(rows.read(["key"])["key"].to_pylist())
        return keys


def _filter(selection: Selection) -> Any:
    where = (pc.field("day") >= selection.first_day) & (pc.field("day") <= selection.last_day)
    for name, chosen in (("cell", selection.cells), ("label", selection.objects)):
        if chosen:
            where &= pc.field(name).isin(sorted(chosen))
    return where


@contextmanager
def _named(target: str) -> Iterator[None]:
    """Name the archive in errors of the store."""
    try:
        yield
    except (OSError, ValueError, ImportError, pa.ArrowException) as error:
        raise ArchiveError(f"archive {target}: {error}; check place and rights") from error


@contextmanager
def _readable(path: str) -> Iterator[None]:
    """Name a file of the archive in errors of reading."""
    try:
        yield
    except (OSError, pa.ArrowException) as cause:
        raise ArchiveError(
            f"{path} cannot be read ({cause}); remove it and {SOURCES} of the archive, and "
            "archive its recording again"
        ) from cause
