"""Backup of a cell: one tar of its files, and its restore into a new folder."""

import os
import tarfile
from collections.abc import Iterator, Sequence
from glob import escape
from io import BytesIO
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import BinaryIO

from cell.checks.findings import STORE_NAME
from cell.commissioning.bench import CONFIG_NAME
from cell.commissioning.engine import RECORD_NAME
from cell.config.file import config_file_text, load_config
from cell.config.model import CellConfig
from cell.control.self_zero import zero_file
from cell.errors import CellError, reason_text
from cell.files import DAMAGE, open_plain, write_atomically
from cell.learning.model import LAST_MODEL

_KEPT = (
    *(STORE_NAME, RECORD_NAME, LAST_MODEL),
    *("backup-servo*.json", "*.npz", "*.photos/*.jpg", "*.photos/*.png"),
)
"""Files of a cell in its folder, beside its config."""
_MESH = "mesh:file="
"""Begin of a shape that names a file."""


def back_up(path: Path, config_file: Path, models: Sequence[Path] = ()) -> int:
    """Write the files of a cell to a new tar; return their number.

    The config has the name `CONFIG_NAME` there. Raises ConfigError if the config is not valid.
    Raises CellError if a file cannot be read or written, if a shape is outside of the folder, or if
    two files have the same name.

    Parameters
    ----------
    path
        The tar; an existing file is never overwritten.
    config_file
        Config of the cell; findings, record, backups of the servos, models, data sets and photos
        are beside it.
    models
        Models in other folders, with their data sets and photos.
    """
    config = load_config(config_file)
    if os.path.lexists(path):
        raise CellError(f"{path} exists; backups are never overwritten, name another file")
    files = dict[str, Path]()
    for name, source in (*_own_files(config_file.parent, models), *_named_files(config)):
        if files.setdefault(name, source).resolve() != source.resolve():
            raise CellError(f"{files[name]} and {source} have the same name; rename one of them")
    text = config_file_text(config_file).encode()

    def write(out: BinaryIO) -> None:
        with tarfile.open(fileobj=out, mode="w", dereference=True) as archive:
            for name, source in files.items():
                with open_plain(source, error=CellError, what="file") as file:
                    archive.addfile(archive.gettarinfo(arcname=name, fileobj=file), file)
            # The config is last: an archive that is cut off lacks it.
            info = archive.gettarinfo(config_file, CONFIG_NAME)
            info.size = len(text)
            archive.addfile(info, BytesIO(text))

    write_atomically(path, write, error=CellError, what="backup")
    return len(files) + 1


def _own_files(folder: Path, models: Sequence[Path]) -> Iterator[tuple[str, Path]]:
    """Yield name and path of the files in the folder of the cell, and those of models."""
    yield from _matching(folder, *_KEPT)
    for model in models:
        stem = escape(model.stem)
        yield model.name, model
        yield from _matching(model.parent, f"{stem}.grasps.npz", f"{stem}.photos/*.???")


def _matching(folder: Path, *patterns: str) -> Iterator[tuple[str, Path]]:
    found = (path for pattern in patterns for path in sorted(folder.glob(pattern)))
    return ((path.relative_to(folder).as_posix(), path) for path in found if path.is_file())


def _named_files(config: CellConfig) -> Iterator[tuple[str, Path]]:
    """Yield name and path of the files that a config names: shapes, and a self-zero beside it.

    Raises CellError for a shape outside the folder.
    """
    zero = zero_file(Path(config.recording.directory), config.name)
    if zero.is_file() and not _leaves(str(zero)):
        yield zero.as_posix(), zero
    for shape in (one.shape for one in config.simulator.objects):
        mesh = shape.removeprefix(_MESH)
        if mesh != shape and _leaves(mesh):
            raise CellError(f"{mesh} is outside of the folder of the config; copy it there")
        if mesh != shape:
            yield PurePosixPath(mesh).as_posix(), Path(mesh)


def _leaves(name: str) -> bool:
    """Return whether a path leaves the folder that it is relative to."""
    return name.startswith("/") or ".." in PurePosixPath(name).parts


def restore(path: Path, folder: Path) -> int:
    """Unpack a backup into a new folder; return the number of its files.

    Nothing is written before the whole backup is checked. Raises CellError if the folder is not
    empty; if the backup is cut off or damaged, or has a link, a device or a path that leaves the
    folder; or if the files cannot be written.
    """
    if os.path.lexists(folder) and (not folder.is_dir() or any(folder.iterdir())):
        raise CellError(f"{folder} is not an empty folder; name a new folder")
    try:
        with (
            open_plain(path, error=CellError, what="backup") as file,
            tarfile.open(fileobj=file, mode="r:") as archive,
        ):
            refused = ((one, _refusal(one)) for one in archive)
            wrong = next((f"{one.name!r:.80} {why}" for one, why in refused if why), "")
            if not wrong and CONFIG_NAME not in archive.getnames():
                wrong = f"it has no {CONFIG_NAME}, so it is cut off or no backup of a cell"
            if wrong:
                raise CellError(f"{path}: {wrong}; nothing was written, use another copy of it")
            folder.parent.mkdir(parents=True, exist_ok=True)
            # Python before 3.11.4 has no filter; names and types are checked above.
            archive.extraction_filter = getattr(tarfile, "data_filter", None)
            with TemporaryDirectory(dir=folder.parent) as part:
                archive.extractall(part)
                folder.mkdir(exist_ok=True)
                for one in Path(part).iterdir():
                    one.rename(folder / one.name)
            return len(archive.getnames())
    except (*DAMAGE, tarfile.TarError, OSError) as error:
        reason = f"{reason_text(error)}; use another copy of the backup, or another folder"
        raise CellError(f"cannot restore {path} to {folder}: {reason}") from error


def _refusal(member: tarfile.TarInfo) -> str:
    """Return why a member of an archive is refused; empty for a file or folder inside it."""
    if _leaves(member.name):
        return "leaves the folder"
    file = member.isfile() and not member.issparse() and member.size >= 0
    return "" if file or member.isdir() else "is a link, a device or another special file"
