"""Ingestion: recordings and data sets are added to an archive, each file once."""

import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from cell.archive.selection import of_cell
from cell.archive.store import BUSY, Archive, Row, batches, grasp_key, recording_rows
from cell.errors import ArchiveError, CellError, reason_text
from cell.files import alone_in, array_names, open_plain
from cell.learning.parallel import one_blas_thread
from cell.recording.dataset import read_grasps
from cell.recording.reader import read_recording
from cell.recording.sink import in_use
from recognition.evaluation.evaluation import Mapper, one_by_one

_KINDS = (".mcap", ".npz")
"""Endings of recordings and data sets; recordings first, since they hold more data."""
_open = partial(open_plain, error=CellError, what="file")

Names = dict[str, tuple[str, str]]
"""Label and series of grasps by their keys."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Piece:
    """One file after a worker has read it."""

    source: Path
    sha256: str = ""
    staged: str = ""
    """Name of its staged rows; empty where the file is already in the archive."""
    left: str = ""
    """Reason to leave it for the next run; empty where it is not left."""


@dataclass(slots=True, kw_only=True)
class Ingested:
    """Result of an ingestion."""

    n_files: int = 0
    n_there: int = 0
    """Added files, and files that were already in the archive."""
    n_grasps: int = 0
    n_before: int = 0
    """Added grasps, and grasps of added files that another file had already added."""
    left: dict[str, str] = field(default_factory=dict)
    """Files that are left for the next run, with the reason."""


def sources(places: Sequence[Path]) -> list[Path]:
    """Return the recordings and data sets of some folders and files.

    The models in a folder, whose grasps runs have recorded beside them, are left out. Raises
    ArchiveError where one does not exist or cannot be read, or no file is found.
    """
    files: list[Path] = []

    def refuse(error: OSError) -> NoReturn:
        raise ArchiveError(
            f"{error.filename} cannot be read: {error.strerror}; permit it, or name other folders"
        ) from error

    for place in places:
        if place.is_dir():
            walked = os.walk(place, onerror=refuse, followlinks=True)
            paths = sorted(Path(folder, name) for folder, _, names in walked for name in names)
            known = (path for path in paths if path.suffix in _KINDS)
            files += [path for path in known if "model" not in array_names(path)]
        elif place.exists():
            files.append(place)
        else:
            raise ArchiveError(f"{place} is not there: name folders, recordings or data sets")
    if not files:
        raise ArchiveError(
            f"no recording (.mcap) and no data set (.npz) in {', '.join(map(str, places))}"
        )
    return list(dict.fromkeys(path.resolve() for path in files))


def ingest(
    target: str,
    paths: Iterable[Path],
    *,
    cell: str = "",
    mapper: Mapper = one_by_one,
    progress: Callable[[str, int, int], None],
) -> Ingested:
    """Add files to the archive at a folder or URL. Raises ArchiveError where it cannot be written.

    Parameters
    ----------
    paths
        Recordings and data sets, as `sources` returns them.
    cell
        Cell of grasps that name no cell.
    mapper
        Reads the files, in this or other processes, or on other machines with the same folders; the
        results are added here, in the order of the files.
    """
    archive, done = Archive(target, create=True), Ingested()
    with alone_in(archive.folder, ArchiveError(BUSY)) if archive.folder else nullcontext():
        archive.clear_staged()
        every = sorted(paths, key=lambda path: path.suffix != _KINDS[0])
        progress("archive", 0, len(every))
        work = partial(read_piece, target, cell, _names(every))
        for number, piece in enumerate(mapper(work, every), start=1):
            progress("archive", number, len(every))
            if piece.left:
                done.left[str(piece.source)] = piece.left
            elif not piece.staged or archive.has_source(piece.sha256):  # or a copy of it, meanwhile
                done.n_there += 1
            else:
                try:
                    new, before = archive.add(piece.sha256, str(piece.source), piece.staged)
                except ArchiveError as why:
                    Archive(target)  # raises where the whole archive is out of reach
                    done.left[str(piece.source)] = str(why)
                    continue
                done.n_files += 1
                done.n_grasps, done.n_before = done.n_grasps + new, done.n_before + before
        archive.clear_staged()
    return done


def _names(paths: Sequence[Path]) -> Names:
    names: Names = {}
    recorded = any(path.suffix == _KINDS[0] for path in paths)
    for path in paths:
        if recorded and path.suffix == _KINDS[1]:
            with suppress(CellError, OSError):  # what is wrong with it is said where it is added
                names |= {grasp_key(g): (g.label, g.series) for g in read_grasps(path)}
    return names


@one_blas_thread()
def read_piece(target: str, cell: str, names: Names, path: Path) -> Piece:
    """Read one file and stage its grasps beside the archive; a problem is in `left`.

    ``names`` are the label and the series by the key of each grasp that a data set names.
    """
    try:
        if path.suffix == ".mcap" and in_use(path):
            return Piece(source=path, left="a program still writes to it")
        with _open(path) as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        archive = Archive(target)
        if archive.has_source(sha256):
            return Piece(source=path, sha256=sha256)
        staged = archive.stage(sha256, _batches(path, cell, names, sha256))
    except ArchiveError:
        raise
    except (CellError, OSError) as why:
        return Piece(source=path, left=str(why))
    return Piece(source=path, sha256=sha256, staged=staged)


def _batches(path: Path, cell: str, names: Names, sha256: str) -> Iterator[Any]:
    """Yield the rows of a file; CellError for any content that does not fit."""
    try:
        yield from batches(_rows(path, cell, names), str(path), sha256)
    except CellError:
        raise
    except Exception as why:
        raise CellError(f"its content does not fit an archive: {reason_text(why)}") from why


def _rows(path: Path, cell: str, names: Names) -> list[Row]:
    if path.suffix != ".mcap":
        return [(of_cell(grasp, cell), {"grasp": i}) for i, grasp in enumerate(read_grasps(path))]
    recording = read_recording(path)
    if not recording.complete:
        raise CellError(f"it is {recording.incomplete}")
    rows: list[Row] = []
    for grasp, further in recording_rows(recording, cell):
        label, series = names.get(grasp_key(grasp), (grasp.label, grasp.series))
        rows.append((replace(grasp, label=label, series=series), further))
    return rows
