"""Export of a part of an archive: one file of CSV or Parquet, or a data set."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

from cell.archive.selection import EVERYTHING, Selection
from cell.archive.store import Archive, nothing_selected
from cell.archive.table import LIGHT, SCHEMA
from cell.data.dataset import write_dataset
from cell.data.files import write_atomically
from cell.errors import ArchiveError

KINDS = (".csv", ".parquet", ".npz")
"""File endings of exports."""
_HELD_BYTES = 1 << 30
"""Largest size of frames in a data set: it is written whole, and read up to that size."""


def export(archive: Archive, path: Path, selection: Selection = EVERYTHING) -> int:
    """Write the selected grasps to one file, whole or not at all; return their number.

    CSV has all columns with numbers or texts, Parquet all; both have cell and day. A data set has
    labels and frames. Raises ArchiveError where no grasp is selected or a data set would be too
    large, and DatasetError where its grasps were taken on different pads.
    """
    if path.suffix not in KINDS:
        raise ArchiveError(f"{path}: name a file that ends in {', '.join(KINDS)}")
    n = archive.n_rows(selection)
    if not n:
        raise nothing_selected(archive.target)
    if path.suffix == ".npz":
        held, grasps = 0, []
        for grasp in archive.grasps(selection):
            held += grasp.counts.nbytes
            if held > _HELD_BYTES:
                raise ArchiveError(
                    f"{n} grasps have more than {_HELD_BYTES} bytes of frames: select fewer, or "
                    "write Parquet"
                )
            grasps.append(grasp)
        write_dataset(path, grasps)
        return n
    names = list(SCHEMA.names) if path.suffix == ".parquet" else list(LIGHT)
    write_atomically(
        path,
        lambda file: _write(file, path.suffix, _pieces(archive, selection, names)),
        error=ArchiveError,
        what="export",
    )
    return n


def _pieces(archive: Archive, selection: Selection, names: list[str]) -> Iterator[pa.RecordBatch]:
    for partition, batch in archive.batches(names, selection):
        n = batch.num_rows
        texts = (pa.array([text] * n) for text in (partition.cell, partition.day))
        columns = dict(zip(("cell", "day"), texts, strict=True))
        columns |= dict(zip(names, batch.columns, strict=True))
        yield pa.RecordBatch.from_pydict(columns)


def _flat(batch: pa.RecordBatch) -> pa.RecordBatch:
    """Return rows with a column for each number of a structure, without lists and maps."""
    columns: dict[str, Any] = {}
    for name, values in zip(batch.schema.names, batch.columns, strict=True):
        if pa.types.is_struct(values.type):
            fields = [one.name for one in values.type]
            columns |= {f"{name}_{field}": pc.struct_field(values, field) for field in fields}
        elif not pa.types.is_nested(values.type):
            columns[name] = values
    return pa.RecordBatch.from_pydict(columns)


def _write(file: Any, kind: str, pieces: Iterator[pa.RecordBatch]) -> None:
    writer = None
    for piece in pieces:
        rows = _flat(piece) if kind == ".csv" else piece
        if writer is None:
            writer = (
                pyarrow.csv.CSVWriter(file, rows.schema)
                if kind == ".csv"
                else pq.ParquetWriter(
                    file, rows.schema.with_metadata(SCHEMA.metadata), compression="zstd"
                )
            )
        writer.write_batch(rows)
    if writer is not None:
        writer.close()
