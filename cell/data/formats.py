"""Formats of a cell's files: the written version, and how older versions are read.

A file names its format and version. A later version is refused. A file without a format was written
by tactile-cell 28346af4 or before.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cell.data.files import json_bytes, read_plain, write_text
from cell.errors import CellError

_CHECKSUM = "sha256"
"""Key of a JSON file with the checksum of its other keys."""
KEPT_BYTES = 4 << 20
"""Largest JSON file that is read: ten times the largest file, findings of 400 taxels."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Format:
    """Format of one kind of file, and its version."""

    what: str
    """Kind of the file, for messages."""
    text: str
    """Format and version in the file."""
    remedy: str
    """Remedy for a file that cannot be read."""
    earlier: frozenset[str] = frozenset()
    """Formats of earlier versions that are also read."""
    unnamed: frozenset[str] | None = None
    """Keys of a JSON file without a format that is read; None: such a file is refused."""

    def __str__(self) -> str:
        return self.text

    def check(self, found: object, source: object, error: type[CellError]) -> None:
        """Raise ``error`` if a file names another format."""
        if isinstance(found, str) and found in (self.text, *self.earlier):
            return
        name, version = self.text.split("/")
        later = re.fullmatch(rf"{name}/(\d{{1,9}})", str(found))
        if later and int(later[1]) > int(version):
            raise error(
                f"{source} has the format {found}; this program reads up to {self}: update "
                "tactile-cell"
            )
        named = "it names no format" if found is None else f"its format is {str(found)!a:.60}"
        raise error(f"{source} is not a {self.what}: {named}, expected {self}; {self.remedy}")


GONE_KEYS: Mapping[str, Mapping[Any, Any] | None] = {
    "sequence.kind": {"active": "random"},
    "sequence.candidates": None,
    "serve.foxglove_port": None,
}
"""Removed keys of a config (None), and removed values of a key with their replacements."""


def present_config(values: dict[str, Any], way: str = "") -> dict[str, Any]:
    """Return the values of a config, or of the section at a dotted path, without removed ones."""
    found = {}
    for name, value in values.items():
        gone = GONE_KEYS.get(f"{way}{name}", {})
        if gone is None:
            continue
        if isinstance(value, dict):
            found[name] = present_config(value, f"{way}{name}.")
        else:
            found[name] = gone.get(value, value) if isinstance(value, str) else value
    return found


CONFIG = Format(
    what="config",
    text="tactile-cell-config/1",
    remedy="write that, or leave the key out",
)
DATASET = Format(what="grasp data set", text="grasp-dataset/1", remedy="check the path")
RECORDING = Format(what="recording", text="tactile-cell-recording/1", remedy="check the path")
MODEL = Format(
    what="model",
    text="tactile-cell-model/1",
    remedy="train it again: `tactile-cell train DATASETS -o MODEL`",
)
COMMISSIONING = Format(
    what="commissioning",
    text="tactile-cell-commissioning/1",
    remedy="move it away to commission anew",
    unnamed=frozenset({"version", "steps", "approved"}),
)
SERVO_BACKUP = Format(
    what="backup of a servo",
    text="tactile-cell-servo-backup/1",
    remedy="take another copy of it",
    unnamed=frozenset({"servo_id", "baud_rate", "found"}),
)
SELF_ZERO = Format(
    what="self-zero",
    text="tactile-cell-self-zero/2",
    earlier=frozenset({"tactile-cell-self-zero/1"}),
    remedy="`tactile-cell zero` measures it anew",
)
CELL_BACKUP = Format(
    what="backup of a cell",
    text="tactile-cell-backup/1",
    remedy="take another copy of it",
)
ARCHIVE = Format(
    what="archive",
    text="tactile-cell-archive/1",
    remedy="archive the recordings again, to a new place",
)
RETENTION = Format(
    what="list of the recordings' ages",
    text="tactile-cell-recordings/1",
    remedy="remove it: the recordings then count as new",
)


def write_json(path: Path, kind: Format, content: Any, *, error: type[CellError]) -> None:
    """Write a mapping or dataclass as JSON with format and checksum; see `write_text`."""
    write_text(path, json_text(kind, content), error=error, what=kind.what)


def json_text(kind: Format, content: Any) -> str:
    """Return a mapping or dataclass as JSON with format and checksum."""
    values = {"format": str(kind), **json.loads(json_bytes(content))}
    return json.dumps(values | {_CHECKSUM: _digest(values)}, indent=2) + "\n"


def read_json(path: Path, kind: Format, *, error: type[CellError]) -> dict[str, Any] | None:
    """Return the content of a file that `write_json` wrote; None without the file.

    Raises ``error`` if it is damaged, too large, not a plain file, or of another format.
    """
    try:
        data = read_plain(path, error=error, what=kind.what, limit_bytes=KEPT_BYTES)
    except error as refused:
        if isinstance(refused.__cause__, FileNotFoundError):
            return None
        raise
    return parse_json(data, kind, path, error=error)


def parse_json(
    data: bytes, kind: Format, source: object, *, error: type[CellError]
) -> dict[str, Any]:
    """Return the content of a text of `json_text`. Raises ``error`` as `read_json`."""
    try:
        values = json.loads(data)
    except (ValueError, RecursionError) as cause:
        raise error(f"{source} is damaged, it is not JSON; {kind.remedy}") from cause
    if not isinstance(values, dict):
        raise error(f"{source} is not a {kind.what}: it has no object; {kind.remedy}")
    if values.keys() == kind.unnamed:
        return values
    kind.check(values.get("format"), source, error)
    stated = values.pop(_CHECKSUM, None)
    if stated != _digest(values):
        raise error(f"{source} is damaged, its checksum is wrong; {kind.remedy}")
    del values["format"]
    return values


def checksum(pieces: Iterable[bytes]) -> str:
    """Return the SHA-256 over some bytes in pieces, as hexadecimal digits."""
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return digest.hexdigest()


def _digest(values: Mapping[str, Any]) -> str:
    return checksum([json.dumps(values, sort_keys=True).encode()])
