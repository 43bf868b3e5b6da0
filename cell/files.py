"""Files of a cell: bounded reading, atomic writing, and the format that each file names."""

import errno
import fcntl
import hashlib
import itertools
import json
import os
import secrets
import stat
import sys
import tokenize
import unicodedata
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.metadata import version
from io import BufferedReader
from pathlib import Path
from typing import IO, Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic_core import to_json

from cell.errors import CellError, reason_text
from recognition.recognizer import UNKNOWN

_END_BYTES = 22
"""End of central directory of a zip archive without its comment; member count at offset 10."""
_PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Packings whose unpacked size is checked during unpacking."""
_RECORDING = b"\x89MCAP"
"""First bytes of an MCAP file."""
_ARCHIVE = b"PK"
"""First bytes of a zip archive."""
_PLAIN_KINDS = "biufUS"
"""Kinds of numpy types that are read: booleans, numbers and strings."""
DAMAGE = (
    zipfile.BadZipFile,
    zlib.error,
    EOFError,
    RuntimeError,
    ValueError,
    SyntaxError,
    tokenize.TokenError,
    MemoryError,
    ArithmeticError,
    TypeError,
    LookupError,
)
"""Errors of Python and its libraries for damaged bytes, or arrays that do not fit."""


def open_plain(path: Path, *, error: type[CellError], what: str) -> BufferedReader:
    """Open a plain file for reading. Anything else is refused: a pipe or device could block.

    Raises ``error``; its message names ``what``.
    """
    try:
        if stat.S_ISREG(path.stat().st_mode):
            flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK
            return os.fdopen(os.open(path, flags), "rb")
    except (OSError, ValueError) as cause:
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"cannot read {what} {path}: {reason}; check the path") from cause
    inside = ", and name a file in this folder" if path.is_dir() else ""
    raise error(f"cannot read {what} {path}: not a plain file; check the path{inside}")


def read_plain(path: Path, *, error: type[CellError], what: str, limit_bytes: int) -> bytes:
    """Return the bytes of a plain file. Raises ``error`` as `open_plain`, or for a longer one."""
    with open_plain(path, error=error, what=what) as file:
        # Read no more than the file's size: a read allocates all that it asks for.
        data = file.read(min(os.fstat(file.fileno()).st_size, limit_bytes) + 1)
    if len(data) > limit_bytes:
        raise error(f"{path}: too long; a {what} has at most {limit_bytes} bytes")
    return data


def name_in_file(name: str) -> str:
    """Return a name as a part of a file name; names that differ in punctuation alone differ too."""
    plain = "".join(sign if sign.isascii() and sign.isalnum() else "-" for sign in name)[:60]
    return plain if plain == name else f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


def free_name(path: Path) -> Path:
    """Return an unused name beside a file: ``cell.1.yaml`` for ``cell.yaml``."""
    names = (path.with_suffix(f".{number}{path.suffix}") for number in itertools.count(1))
    return next(name for name in names if not os.path.lexists(name))


def write_atomically(
    path: Path, write: Callable[[BinaryIO], object], *, error: type[CellError], what: str
) -> None:
    """Write a file beside its place and move it there when it is whole and on the disk.

    Parameters
    ----------
    path
        Path of the file; an existing file stays until the new one is whole.
    write
        Writes the content to the open binary file.
    error, what
        Raised, with ``what`` in its message, if the disk is full, the folder is missing or not
        writable, or ``path`` is not a plain file or write-protected.
    """
    place = Path(os.path.realpath(path))
    # A rename would replace a protected file.
    if place.exists() and not (place.is_file() and place.stat().st_mode & stat.S_IWUSR):
        why = "write-protected" if place.is_file() else "not a plain file"
        raise error(f"cannot write {what} to {path}: {why}; move it away, or choose another name")
    part = place.with_name(f".{place.name}.{secrets.token_hex(4)}.part")
    try:
        handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        try:
            with os.fdopen(handle, "wb") as file:
                write(file)
                file.flush()
                os.fsync(file.fileno())
            if place.exists():
                part.chmod(stat.S_IMODE(place.stat().st_mode))
            part.replace(place)
        except BaseException:
            part.unlink(missing_ok=True)
            raise
    except OSError as cause:
        old = "; the old file is unchanged" if place.exists() else ""
        raise error(f"cannot write {what} to {path}: {_advice(cause, place)}{old}") from cause


@contextmanager
def alone_in(folder: Path, busy: CellError | None = None) -> Iterator[None]:
    """Lock a folder (flock), until this process ends at the latest.

    Raises ``busy`` if another process holds it; None: waits for it.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (fcntl.LOCK_NB if busy else 0))
        except BlockingIOError as error:
            raise busy or error from error
        yield
    finally:
        os.close(handle)


def write_text(path: Path, text: str, *, error: type[CellError], what: str) -> None:
    """Write a UTF-8 text file; see `write_atomically`."""
    write_atomically(path, lambda file: file.write(text.encode()) and None, error=error, what=what)


def json_bytes(value: Any) -> bytes:
    """Return data as JSON, also dataclasses, paths and arrays; null for NaN and infinity."""

    def plain(other: Any) -> Any:
        return dict(other) if isinstance(other, Mapping) else other.tolist()

    return to_json(value, indent=2, inf_nan_mode="null", fallback=plain)


def _advice(cause: OSError, place: Path) -> str:
    if cause.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"no space left in {place.parent}; free some or choose another folder"
    if cause.errno == errno.ENOENT:
        return f"the folder {place.parent} does not exist; make it first"
    if cause.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        why = cause.strerror
        return f"{place.parent} is not writable ({why}); make it so, or choose another folder"
    return f"{cause.strerror or cause}"


def savez(file: IO[bytes], arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write plain arrays as a compressed npz. Raises ValueError for arrays of Python objects.

    The bytes depend only on the arrays, not on the time of writing.
    """
    # At this level deflate takes a fifth of the usual time, for files of the same size.
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED, compresslevel=4) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)


def array_names(path: Path) -> set[str]:
    """Return the names of the arrays of an npz archive; none for anything else."""
    with (
        suppress(CellError, OSError, zipfile.BadZipFile),
        open_plain(path, error=CellError, what="file") as file,
        zipfile.ZipFile(file) as archive,
    ):
        return {name.removesuffix(".npy") for name in archive.namelist()}
    return set()


def read_npz(
    path: Path,
    *,
    error: type[CellError],
    what: str,
    limit_bytes: int,
    wanted: Callable[[str], bool] = lambda _name: True,
) -> dict[str, NDArray[Any]]:
    """Read arrays of an npz archive that may be damaged or hostile; they are read-only.

    Only numbers, booleans and strings are read; nothing in the file is ever executed. Arrays whose
    names are not ``wanted`` are neither read nor unpacked. Sizes are compared with ``limit_bytes``
    (all arrays together, unpacked) before anything is unpacked.

    Raises
    ------
    CellError
        Of the class ``error``, naming the file, the array and the reason.
    """
    arrays: dict[str, NDArray[Any]] = {}
    where = ""
    try:
        with open_plain(path, error=error, what=what) as file:
            head = file.read(len(_RECORDING))
            if head == _RECORDING:
                raise error(
                    f"{path} is a recording, not a {what}; rename it to end in .mcap, then train "
                    "and evaluate read its grasps"
                )
            if not head.startswith(_ARCHIVE):
                content = "not an npz archive" if head else "empty"
                raise error(f"{path} is not a {what}: it is {content}; name a {what} (.npz)")
            archive = zipfile.ZipFile(file)
            every = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
            members = {name: member for name, member in every.items() if wanted(name)}
            total = sum(member.file_size for member in members.values())
            if total > limit_bytes:
                raise error(
                    f"{path} unpacks to {total} bytes, the limit is {limit_bytes} bytes; write the "
                    f"{what} in several files"
                )
            for name, member in members.items():
                where = f"array {name}: "
                arrays[name] = _read_array(archive, member)
            where = ""
            _check_directory(file, len(archive.comment), len(every))
    except OSError as cause:
        reason = cause.strerror or str(cause)
        raise error(f"cannot read {what} {path}: {reason}; check the path") from cause
    except DAMAGE as cause:
        raise error(
            f"{path} is a damaged {what} ({where}{reason_text(cause)}); take another copy of it"
        ) from cause
    return arrays


def _check_directory(file: BinaryIO, n_comment: int, n_arrays: int) -> None:
    """Refuse a damaged list of members: zipfile skips entries, and a name may be there twice."""
    file.seek(-_END_BYTES - n_comment, os.SEEK_END)
    stated = int.from_bytes(file.read(_END_BYTES)[10:12], "little")
    if stated != n_arrays:
        raise zipfile.BadZipFile(f"its directory counts {stated} arrays, {n_arrays} are there")


def _read_array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> NDArray[Any]:
    """Return a read-only array. Raises one of `DAMAGE` if the member has something else."""
    if member.compress_type not in _PACKINGS:
        # zipfile unpacks these without a bound, whatever size the archive states.
        raise ValueError(f"packed by method {member.compress_type}, not zlib")
    with archive.open(member) as stream:
        # What numpy.load calls for a .npy; on other bytes numpy.load advises to allow pickles.
        array: NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
        if array.dtype.kind not in _PLAIN_KINDS:
            raise ValueError("no plain numbers, booleans or strings")
        # Texts without a size take no byte of the file: any number of them would fit.
        if stream.read(1) or array.size > member.file_size:
            raise ValueError(f"shape {array.shape} does not fit {member.file_size} bytes")
    if array.dtype.kind == "U":
        codes = array.ravel().view(np.dtype(np.uint32).newbyteorder(array.dtype.byteorder))
        if np.any(codes > sys.maxunicode):
            raise ValueError("has a number that is not a character")
    array.setflags(write=False)
    return array


PROGRAM = f"tactile-cell {version('tactile-cell')}"
"""Name and version of this program."""
MAX_TEXT = 200
"""Most characters of a text of a grasp, for example its label."""
_CHECKSUM = "sha256"
"""Key of a JSON file with the checksum of its other keys."""
_MAX_BYTES = 4 << 20
"""Largest JSON file that is read: ten times the largest file, findings of 400 taxels."""


class Format(NamedTuple):
    """Format of one kind of file, and its version."""

    what: str
    """Kind of the file, for messages."""
    text: str
    """Format and version in the file."""
    remedy: str
    """Next step for a file that is damaged or of another format."""

    def __str__(self) -> str:
        return self.text

    def check(self, text: object, source: object, error: type[CellError]) -> None:
        """Raise ``error`` if a file names another format or version, or none."""
        if text != self.text:
            named = "it names no format" if text is None else f"its format is {str(text)!a:.60}"
            raise error(f"{source}: {named}, but {PROGRAM} reads {self}; {self.remedy}")

    def read(self, text: str | bytes, source: object, error: type[CellError]) -> dict[str, Any]:
        """Return a JSON object that names this format; raises ``error`` for anything else."""
        try:
            values = json.loads(text)
        except (ValueError, RecursionError) as cause:
            raise error(f"{source} is damaged, it is not JSON; {self.remedy}") from cause
        if not isinstance(values, dict):
            raise error(f"{source} is not a {self.what}: it has no object; {self.remedy}")
        self.check(values.get("format"), source, error)
        return values


_SAME = "use the tactile-cell that wrote it"
CONFIG = Format("config", "tactile-cell-config/1", "write that, or leave the key out")
DATASET = Format("grasp data set", "grasp-dataset/1", _SAME)
RECORDING = Format("recording", "tactile-cell-recording/2", _SAME)
MODEL = Format(
    "model", "tactile-cell-model/2", "train it again: `tactile-cell model train DATASETS -o MODEL`"
)
COMMISSIONING = Format(
    "commissioning", "tactile-cell-commissioning/1", "move it away to commission anew"
)
SERVO_BACKUP = Format(
    "backup of a servo",
    "tactile-cell-servo-backup/2",
    "use another copy of it, or the tactile-cell that wrote it",
)
SERVO_BENCH = Format(
    "result of the bench of a servo",
    "tactile-cell-servo-bench/1",
    "measure the servo again: `tactile-cell hand bench`",
)
SELF_ZERO = Format(
    "self-zero",
    "tactile-cell-self-zero/2",
    "`tactile-cell hand zero`, or the task `zero` of a service, measures it anew",
)
ARCHIVE = Format(
    "archive", "tactile-cell-archive/3", "archive the recordings again, to a new place"
)


def check_text(name: str, text: str) -> None:
    """Raise ValueError for a text of a grasp, e.g. its label, that no file may have."""
    if not text.isprintable() or len(text) > MAX_TEXT:
        raise ValueError(
            f"{name} is {text!a:.60}: not printable, or longer than {MAX_TEXT} characters; write a "
            "plain, shorter text"
        )
    if name == "label" and text == UNKNOWN:
        raise ValueError(
            f"label is {UNKNOWN}, the answer for untaught objects: write a name; a file may also "
            "leave it empty"
        )


def checked_label(label: str) -> str:
    """Return a label that is valid in data sets, models and answers.

    Raises ValueError if it is blank, of dots, or has space around it, or as `check_text`.
    """
    label = unicodedata.normalize("NFC", label)  # both forms of an umlaut are one name
    # In an address . and .. are no names.
    if not label.strip().strip(".") or label != label.strip():
        raise ValueError(
            f"label {label!r:.60} is blank, of dots, or has space around it; write a name"
        )
    check_text("label", label)
    return label


def write_json(path: Path, kind: Format, content: Any, *, error: type[CellError]) -> None:
    """Write a mapping or dataclass as JSON with format and checksum; see `write_text`.

    A missing folder is created.
    """
    values = {"format": str(kind), **json.loads(json_bytes(content))}
    text = json.dumps(values | {_CHECKSUM: _digest(values)}, indent=2) + "\n"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as cause:
        raise error(f"cannot write {kind.what} to {path}: {_advice(cause, path.parent)}") from cause
    write_text(path, text, error=error, what=kind.what)


def read_json(path: Path, kind: Format, *, error: type[CellError]) -> dict[str, Any] | None:
    """Return the content of a file that `write_json` wrote; None without the file.

    Raises ``error`` if it is damaged, too large, not a plain file, or of another format.
    """
    try:
        data = read_plain(path, error=error, what=kind.what, limit_bytes=_MAX_BYTES)
    except error as refused:
        if isinstance(refused.__cause__, FileNotFoundError):
            return None
        raise
    values = kind.read(data, path, error)
    stated = values.pop(_CHECKSUM, None)
    if stated != _digest(values):
        raise error(f"{path} is damaged, its checksum is wrong; {kind.remedy}")
    del values["format"]
    return values


def _digest(values: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()
