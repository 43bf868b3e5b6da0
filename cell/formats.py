"""Formats of a cell's files: each file names its format and version; others are refused."""

import hashlib
import json
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from cell.errors import CellError
from cell.files import json_bytes, read_plain, write_text
from recognition.recognizer import UNKNOWN

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
    "model",
    "tactile-cell-model/1",
    "train it again: `tactile-cell model train DATASETS -o MODEL`",
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
    "self-zero", "tactile-cell-self-zero/2", "`tactile-cell hand zero` measures it anew"
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

    Raises ValueError if it is blank or has space around it, or as `check_text`.
    """
    if not label.strip() or label != label.strip():
        raise ValueError(f"label {label!r:.60} is blank or has space around it; write a name")
    check_text("label", label)
    return label


def write_json(path: Path, kind: Format, content: Any, *, error: type[CellError]) -> None:
    """Write a mapping or dataclass as JSON with format and checksum; see `write_text`.

    A missing folder is created.
    """
    values = {"format": str(kind), **json.loads(json_bytes(content))}
    text = json.dumps(values | {_CHECKSUM: _digest(values)}, indent=2) + "\n"
    with suppress(OSError):  # The write reports the error.
        path.parent.mkdir(parents=True, exist_ok=True)
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
