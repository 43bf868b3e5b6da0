"""Retention of recordings: the oldest are deleted by size and by free space."""

import os
import re
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from cell.errors import RecordingError
from cell.files import write_text
from cell.recording.recorder import Recorder
from cell.recording.sink import free_bytes, in_use

MARK = ".keep"
"""Suffix of the file beside a recording that marks it."""
LEAST_FREE_BYTES = 500_000_000
"""Free bytes of the disk below which the oldest recordings are deleted: three hours of grasping."""

_JOB = re.compile(r"[a-z-]+-\d{8}-\d{6}(-\d+)?")
"""Name of a job's folder; recordings in other folders are not managed."""
_LOOK_S = 10.0
"""Time in s between two checks of the disk."""
_CLOSE_TIMEOUT_S = 1.0
"""Longest wait in s for a blocked disk at the end."""


class Entry(NamedTuple):
    """A recording of a folder."""

    path: Path
    n_bytes: int
    written_s: float
    """Unix time in s of its last write."""
    marked: bool


def mark(path: Path) -> Path:
    """Mark a recording, so that it is never deleted; return the file of its mark.

    Without that file it may be deleted. Of a link the recording itself is marked. Raises
    RecordingError.
    """
    path = path.resolve()
    if path.suffix != ".mcap" or not path.is_file() or not path.stat().st_size:
        raise RecordingError(f"{path} is not a recording, or empty; name an .mcap file with data")
    write_text(file := _mark_of(path), "", error=RecordingError, what="mark")
    return file


def recordings(folder: Path) -> list[Entry]:
    """Return the recordings of all jobs in a folder, oldest first.

    Raises OSError if the folder is gone.
    """
    entries = []
    for job in os.scandir(folder):
        if not (_JOB.fullmatch(job.name) and job.is_dir(follow_symlinks=False)):
            continue
        for path in Path(job.path).glob("recording*.mcap"):
            with suppress(FileNotFoundError):
                stat, marked = path.stat(), _mark_of(path).exists()
                entries.append(Entry(path, stat.st_size, stat.st_mtime, marked))
    return sorted(entries, key=lambda entry: (entry.written_s, entry.path))


class Retention:
    """Deletes the oldest recordings; a missing or blocked disk stops nothing else.

    Parameters
    ----------
    recorder
        Writes the recording of this program, which stays.
    folder
        Folder of all jobs.
    keep_bytes
        Size in bytes beyond which the oldest recordings are deleted; None: no limit.
    note
        Gets messages for the operator.
    """

    def __init__(
        self,
        recorder: Recorder,
        folder: Path,
        *,
        keep_bytes: float | None = None,
        note: Callable[[str], None] = lambda _text: None,
    ) -> None:
        self._recorder, self._folder, self._note = recorder, folder, note
        self._keep_bytes = float("inf") if keep_bytes is None else keep_bytes
        self.problem = ""
        """What prevents the limits, as text for the operator; empty while they are kept."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="retention", daemon=True)

    def start(self) -> None:
        """Check periodically, in a separate thread, until `close`."""
        self._thread.start()

    def close(self) -> None:
        """End the checks; do not wait for a blocked one."""
        self._over.set()
        self._thread.join(_CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        self.enforce()
        while not self._over.wait(_LOOK_S):
            self.enforce()

    def enforce(self) -> None:
        """Delete the oldest recordings above the limits; note what prevents it."""
        try:
            problem = self._delete()
        except OSError as error:
            problem = f"not all recordings in {self._folder} are managed: {error}"
        if problem and problem != self.problem:
            self._note(problem)
        self.problem = problem

    def _delete(self) -> str:
        """Return which limit is still exceeded, or an empty text."""
        own, entries = self._recorder.path, list[Entry]()
        if _JOB.fullmatch(own.parent.name):
            entries = recordings(self._folder)
        free, total, n_deleted = free_bytes(own.parent), sum(entry.n_bytes for entry in entries), 0
        for entry in entries:
            if total <= self._keep_bytes and free >= LEAST_FREE_BYTES:
                break
            with suppress(OSError):  # another program deletes, too, or it is not ours
                if entry.marked or entry.path.resolve() == own.resolve() or in_use(entry.path):
                    continue
                entry.path.unlink()
                total, free, n_deleted = total - entry.n_bytes, free + entry.n_bytes, n_deleted + 1
            with suppress(OSError):  # a report or a model is beside it
                entry.path.parent.rmdir()
        if n_deleted:
            self._note(
                f"{n_deleted} of the oldest recordings are deleted, because of recording.keep_gb "
                "or a full disk; `tactile-cell recording mark FILE` keeps a recording"
            )
        if free < LEAST_FREE_BYTES:
            return (
                f"the disk of {self._folder} has less than {LEAST_FREE_BYTES / 1e6:.0f} MB free, "
                "and no recording can be deleted; free some"
            )
        if total <= self._keep_bytes:
            return ""
        return (
            f"recordings that are written or marked take {total / 1e9:.1f} GB, more than "
            f"recording.keep_gb ({self._keep_bytes / 1e9:g}): delete marked ones, or raise it"
        )


def _mark_of(path: Path) -> Path:
    return path.with_name(path.name + MARK)
