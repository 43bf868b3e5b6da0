"""Store of an archive: Parquet files by cell and day, in a folder or any store of fsspec.

Workers stage the rows of a source as whole files. One writer moves them to their place, so a reader
never sees a half file. `_sources` has a note for each file in the archive; it is written last. So
the next run after a kill reads that file again, and the rows that are there are known by their key.
"""

import json
import secrets
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence, Set
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

import fsspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.parquet as pq

from cell.archive.selection import EVERYTHING, HEAD, Selection
from cell.archive.table import GROUP, PARTITION, SCHEMA, TABLE, grasps_of
from cell.errors import ArchiveError
from cell.formats import ARCHIVE
from recognition.grasp import Grasp

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
            files = sorted(rows.get_fragments(where), key=lambda one: one.path)
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
        return name

    def add(self, sha256: str, source: str, staged: str) -> tuple[int, int]:
        """Move staged files to their place; return the number of new and of known grasps.

        One program at a time may add to an archive.
        """
        new = known = 0
        with _named(self.target):
            self._fs.invalidate_cache()  # a worker has written the files
            for path in self._fs.find(f"{self._root}/{STAGED}/{staged}"):
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
