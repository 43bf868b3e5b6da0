"""Store of an archive: Parquet files by cell and day, in a folder or any store of fsspec.

One writer stages a file whole and then moves it to its place, so a reader never sees a half file.
`_sources` has a note for each file in the archive; readers of Parquet skip it.
"""

import heapq
import json
import secrets
from collections import OrderedDict
from collections.abc import Iterator, Sequence, Set
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any
from urllib.parse import quote, unquote

import fsspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from cell.archive.selection import EVERYTHING, HEAD, Selection
from cell.archive.table import SCHEMA, grasps_of
from cell.data.formats import ARCHIVE
from cell.errors import ArchiveError, CellError
from recognition.grasp import Grasp

SOURCES, STAGED = "_sources", "_staged"
"""Folders of the notes, and of staged files."""
_BATCH = 64
"""Rows in one read."""
_NAME_BYTES = 255
"""Longest name of a folder in bytes (NAME_MAX of Linux)."""
_KEPT_DAYS = 32
"""Days of cells whose keys are kept while grasps are added."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Partition:
    """The grasps of a cell on a day."""

    cell: str
    day: str
    files: tuple[str, ...]
    """Its Parquet files, sorted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StagedFile:
    """Rows of one source, cell and day, staged before the move to their place."""

    cell: str
    day: str
    path: str


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
        self._fs, self._root = _opened(target)
        head = f"{self._root}/{HEAD}"
        with _named(target):
            if self._fs.exists(head):
                try:
                    found = json.loads(self._fs.cat_file(head)).get("format")
                except (ValueError, AttributeError):
                    found = None
                ARCHIVE.check(found, target, ArchiveError)
            elif not create:
                raise ArchiveError(
                    f"{target} is not an archive; `tactile-cell archive RECORDINGS --to {target}` "
                    "makes one"
                )
            else:
                self._fs.makedirs(self._root, exist_ok=True)
                self._fs.pipe_file(head, json.dumps({"format": str(ARCHIVE)}).encode())
        self._keys: OrderedDict[tuple[str, str], dict[str, set[str]]] = OrderedDict()

    # Reading

    def partitions(self, selection: Selection = EVERYTHING) -> Iterator[Partition]:
        """Yield the selected cells and days that have grasps, sorted."""
        with _named(self.target):
            for cell, folder in self._folders(self._root, "cell"):
                for day, place in self._folders(folder, "day"):
                    if selection.has(cell, day):
                        yield Partition(cell=cell, day=day, files=self._files(place))

    def batches(
        self,
        columns: Sequence[str],
        selection: Selection = EVERYTHING,
        partitions: Sequence[Partition] | None = None,
        keys: Set[str] | None = None,
    ) -> Iterator[tuple[Partition, pa.RecordBatch]]:
        """Yield some columns of the selected rows in pieces, of all or of the given partitions.

        With ``keys``, only groups of rows that contain one of them are read.
        """
        known = bool(selection.objects)
        wanted = [*columns, *(["label"] if known and "label" not in columns else [])]
        for partition in self.partitions(selection) if partitions is None else partitions:
            for path in partition.files:
                for batch in self._batches(path, wanted, keys):
                    rows = batch
                    if known:
                        labels = pa.array(sorted(selection.objects))
                        rows = rows.filter(pc.is_in(rows.column("label"), value_set=labels))
                    if rows.num_rows:
                        yield partition, rows.select(list(columns))

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
        for _, batch in self.batches(SCHEMA.names, selection, keys=chosen):
            rows = batch
            if chosen is not None:
                rows = rows.filter(pa.array([k in chosen for k in rows.column("key").to_pylist()]))
            if rows.num_rows:
                yield from grasps_of(rows)

    def n_rows(self, selection: Selection = EVERYTHING) -> int:
        """Return the number of selected grasps."""
        return sum(rows.num_rows for _, rows in self.batches(["label"], selection))

    def _sample(self, selection: Selection, most: int) -> set[str]:
        """Return the smallest keys of each label."""
        kept: dict[str, list[tuple[int, str]]] = {}
        for _, batch in self.batches(["key", "label"], selection):
            for row in batch.to_pylist():
                if row["label"]:
                    heap = kept.setdefault(row["label"], [])
                    heapq.heappush(heap, (-int(row["key"], 16), row["key"]))
                    if len(heap) > most:
                        heapq.heappop(heap)
        return {key for heap in kept.values() for _, key in heap}

    def _inside(self, place: str) -> list[str]:
        """Return the content of a folder, sorted; a pattern would interpret brackets in names."""
        if not self._fs.exists(place):
            return []
        return sorted(str(path) for path in self._fs.ls(place, detail=False))

    def _folders(self, place: str, name: str) -> Iterator[tuple[str, str]]:
        for path in self._inside(place):
            found, is_named, value = path.rsplit("/", 1)[-1].partition("=")
            if is_named and found == name:
                yield unquote(value), path

    def _files(self, place: str) -> tuple[str, ...]:
        return tuple(path for path in self._inside(place) if path.endswith(".parquet"))

    def _batches(
        self, path: str, columns: Sequence[str], keys: Set[str] | None = None
    ) -> Iterator[pa.RecordBatch]:
        try:
            with self._fs.open(path, "rb") as file, pq.ParquetFile(file) as table:
                found = (table.schema_arrow.metadata or {}).get(b"format", b"").decode()
                ARCHIVE.check(found or None, path, ArchiveError)
                groups = [
                    group
                    for group in range(table.num_row_groups)
                    if keys is None
                    or not keys.isdisjoint(_keys(table.read_row_group(group, columns=["key"])))
                ]
                yield from table.iter_batches(_BATCH, groups, columns=list(columns))
        except (OSError, pa.ArrowException) as cause:
            raise ArchiveError(
                f"{path} cannot be read ({cause}); remove it and {SOURCES} of the archive, and "
                "archive its recording again"
            ) from cause

    # Writing

    def has_source(self, sha256: str) -> bool:
        """Return whether a file of this checksum is in the archive."""
        with _named(self.target):
            return bool(self._fs.exists(self._note(sha256)))

    def stage(self, sha256: str, tables: Iterator[tuple[str, str, pa.Table]]) -> list[StagedFile]:
        """Stage the tables of a source, grouped by cell and day, beside the archive."""
        staged: list[StagedFile] = []
        writer: Any = None
        file: Any = None
        token = f"{sha256[:32]}-{secrets.token_hex(4)}"  # two workers may read two copies of a file
        with _named(self.target):
            try:
                for cell, day, table in tables:
                    if not staged or (staged[-1].cell, staged[-1].day) != (cell, day):
                        _check_name(cell)
                        _close(writer, file)
                        path = f"{self._root}/{STAGED}/{token}-{len(staged)}"
                        self._fs.makedirs(f"{self._root}/{STAGED}", exist_ok=True)
                        file = self._fs.open(path, "wb")
                        writer = pq.ParquetWriter(file, SCHEMA, compression="zstd")
                        staged.append(StagedFile(cell=cell, day=day, path=path))
                    writer.write_table(table)
            finally:
                _close(writer, file)
        return staged

    def add(self, sha256: str, source: str, staged: Sequence[StagedFile]) -> tuple[int, int]:
        """Move staged files to their place; return the number of new and of known grasps.

        One program at a time may add to an archive. A file of the same source is replaced, so its
        grasps are not known ones.
        """
        name = f"{sha256[:32]}.parquet"
        new = before = 0
        with _named(self.target):
            for one in staged:
                folder = f"{self._root}/{_folder(one.cell)}/day={one.day}"
                files = self._known(one.cell, one.day, folder)
                others = (keys for file, keys in files.items() if file != name)
                rows = self._keys_in(one.path)
                fresh, n_rows = set(rows).difference(*others), len(rows)
                if len(fresh) < n_rows and fresh:
                    self._keep(one.path, fresh)
                if fresh:
                    self._fs.makedirs(folder, exist_ok=True)
                    self._fs.mv(one.path, f"{folder}/{name}")
                    fresh, files[name] = fresh - files.get(name, set()), fresh
                else:
                    self._fs.rm_file(one.path)
                new, before = new + len(fresh), before + n_rows - len(fresh)
            note = {"source": source, "sha256": sha256, "grasps": new, "before": before}
            self._fs.makedirs(f"{self._root}/{SOURCES}", exist_ok=True)
            self._fs.pipe_file(self._note(sha256), json.dumps(note).encode())
        return new, before

    def clear_staged(self) -> None:
        """Remove files that an interrupted program left beside the archive."""
        with _named(self.target):
            if self._fs.exists(f"{self._root}/{STAGED}"):
                self._fs.rm(f"{self._root}/{STAGED}", recursive=True)

    def _note(self, sha256: str) -> str:
        return f"{self._root}/{SOURCES}/{sha256}.json"

    def _known(self, cell: str, day: str, folder: str) -> dict[str, set[str]]:
        """Return the keys in each file of a cell and day."""
        if (cell, day) not in self._keys:
            self._keys[cell, day] = {
                path.rpartition("/")[2]: set(self._keys_in(path)) for path in self._files(folder)
            }
            if len(self._keys) > _KEPT_DAYS:
                self._keys.popitem(last=False)
        self._keys.move_to_end((cell, day))
        return self._keys[cell, day]

    def _keys_in(self, path: str) -> list[str]:
        return [key for batch in self._batches(path, ["key"]) for key in _keys(batch)]

    def _keep(self, path: str, fresh: set[str]) -> None:
        """Write a staged file again with only the first row of each of these keys."""
        left = set(fresh)
        with (
            self._fs.open(f"{path}-fresh", "wb") as file,
            pq.ParquetWriter(file, SCHEMA, compression="zstd") as writer,
        ):
            for batch in self._batches(path, SCHEMA.names):
                mask = []
                for key in _keys(batch):
                    mask.append(key in left)
                    left.discard(key)
                writer.write_batch(batch.filter(pa.array(mask)))
        self._fs.mv(f"{path}-fresh", path)


def nothing_selected(target: str) -> ArchiveError:
    """Return the error for a selection without grasps."""
    return ArchiveError(f"no grasp of {target} is selected: look at its folders for cells and days")


def _folder(cell: str) -> str:
    """Return the folder of a cell: its name with ASCII punctuation as in URLs."""
    return "cell=" + "".join(quote(sign, safe=" ") if sign.isascii() else sign for sign in cell)


def _check_name(cell: str) -> None:
    """Raise CellError for a cell whose folder cannot be made."""
    n_bytes = len(_folder(cell).encode(errors="surrogatepass"))
    if n_bytes > _NAME_BYTES:
        raise CellError(
            f"its cell {cell!r:.40} makes a folder name of {n_bytes} bytes, at most {_NAME_BYTES} "
            "are possible: give the cell a shorter name"
        )


def _keys(batch: pa.RecordBatch | pa.Table) -> list[str]:
    return list(batch.column("key").to_pylist())


def _close(*things: Any) -> None:
    for thing in things:
        if thing is not None:
            thing.close()


def _opened(target: str) -> tuple[Any, str]:
    with _named(target):
        fs, root = fsspec.core.url_to_fs(target)
    return fs, root.rstrip("/")


@contextmanager
def _named(target: str) -> Iterator[None]:
    """Name the archive in errors of the store."""
    try:
        yield
    except (OSError, ValueError, ImportError, pa.ArrowException) as error:
        raise ArchiveError(f"archive {target}: {error}; check place and rights") from error
