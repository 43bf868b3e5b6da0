"""Export of a part of an archive: one file of CSV or Parquet, or a data set."""

from itertools import chain
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from cell.archive.selection import EVERYTHING, Selection
from cell.archive.store import Archive, nothing_selected
from cell.archive.table import LIGHT, SCHEMA
from cell.errors import ArchiveError
from cell.files import write_atomically
from cell.recording.dataset import write_dataset

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
    n: int = archive.table(["key"], selection).num_rows
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
    csv = path.suffix == ".csv"
    names = ["cell", "day", *(LIGHT if csv else SCHEMA.names)]
    rows = (pa.Table.from_batches([one]) for one in archive.batches(names, selection))

    def write(file: Any) -> None:
        pieces = map(_flat, rows) if csv else rows
        first = next(pieces)
        with (
            pyarrow.csv.CSVWriter(file, first.schema)
            if csv
            else pq.ParquetWriter(
                file, first.schema.with_metadata(SCHEMA.metadata), compression="zstd"
            )
        ) as writer:
            for piece in chain([first], pieces):
                writer.write_table(piece)

    write_atomically(path, write, error=ArchiveError, what="export")
    return n


def _flat(rows: pa.Table) -> pa.Table:
    """Return rows with a column for each number of a structure, without lists and maps."""
    flat = rows.flatten()
    return flat.select([one.name for one in flat.schema if not pa.types.is_nested(one.type)])
