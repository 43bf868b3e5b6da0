"""Retention of recordings: by age and size, oldest first, and by the remaining space.

A recording ages by the monotonic clock while a program manages its folder; over a stop of all
programs by at most a day. So a jump of the wall clock does not make many recordings old at once.
"""

import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from cell.data import recording_schema as schema
from cell.data.files import write_atomically, write_text
from cell.data.formats import RETENTION, read_json, write_json
from cell.data.recorder import Recorder
from cell.data.recorder_sink import ROOM_BYTES, free_bytes, in_use
from cell.data.recording_messages import RecordedMessages
from cell.data.recording_recovery import RECOVERED, write_messages
from cell.errors import CellError, RecordingError
from recognition.recognizer import UNKNOWN

LEDGER = "recordings.json"
"""File with the ages of the recordings, in the folder of all jobs."""
MARK = ".keep"
"""Suffix of the file beside a recording that marks it."""
THINNED = "thinned"
"""Entry of the metadata: which frames were removed."""
NOTE_S, THIN_S = 3600.0, 1800.0
"""Remaining time in s at which the operator gets a note, and at which recordings are thinned."""
STOP_BYTES = ROOM_BYTES // 2
"""Free bytes below which recordings stop: other files need space."""

_JOB = re.compile(r"[a-z-]+-\d{8}-\d{6}(-\d+)?")
"""Name of a job's folder; recordings in other folders are not managed."""
_DAY_S = 86_400.0
_LOOK_S = 10.0
"""Time in s between two checks of the disk."""
_AGE_S = 3600.0
"""Time in s between two checks of the ages."""
_RATE_S = 60.0
"""Time in s over which the rate of writing is measured."""
_FIRST_RATE = ROOM_BYTES / 420.0
"""Bytes per second before the first measurement: those of grasping."""
_RELIEF = 1.25
"""Factor on the space of a note at which the note is withdrawn."""
_CLOSE_TIMEOUT_S = 1.0
"""Longest wait in s for a blocked disk at the end."""


@dataclass(frozen=True, slots=True)
class Kept:
    """Data of a recording outside its file."""

    age_s: float = 0.0
    """Its age in s, counted by this module."""
    thinned: bool = False
    """Whether frames were removed from it, or could not be removed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """A recording of a folder."""

    path: Path
    n_bytes: int
    marked: bool
    kept: Kept


_LEDGER = TypeAdapter(dict[str, Kept])


def mark(path: Path) -> None:
    """Mark a recording, so that it is never deleted or thinned out. Raises RecordingError."""
    if path.suffix != ".mcap" or not path.is_file():
        raise RecordingError(f"{path} is not a recording; name a file that ends in .mcap")
    write_text(_mark_of(path), "", error=RecordingError, what="mark")


def unmark(path: Path) -> None:
    """Remove the mark of a recording, if it has one. Raises RecordingError on failure."""
    try:
        _mark_of(path).unlink(missing_ok=True)
    except OSError as error:
        raise RecordingError(f"cannot remove the mark of {path}: {error.strerror}") from error


def recordings(folder: Path) -> list[Entry]:
    """Return the recordings of all jobs in a folder, oldest first.

    Raises OSError if the folder is gone, CellError if its ages cannot be read.
    """
    return _entries(folder, _read_ledger(folder)[0])


def thin(path: Path) -> bool:
    """Remove the frames of named parts, and those outside grasps, from a recording.

    All else stays: commands, states, periods of the loop, answers, and the grasps without a name
    with their frames. Returns False if no frame was removed. Raises RecordingError if it cannot be
    read or written.
    """
    spans, named, messages = list[tuple[int, int]](), set[int](), RecordedMessages(path)
    for topic, content, _ in messages:
        if topic == schema.GRASP:
            spans.append((content["first_frame"], len(content["frame_t_s"])))
        elif topic == schema.RESULT and content["label"] != UNKNOWN:
            n_before = max(0, len(spans) - content["n_grasps"])
            named.update(first for first, _ in spans[n_before:])
    left = {first + n for first, n_frames in spans if first not in named for n in range(n_frames)}
    n_out, before = 0, path.stat()

    def stays(topic: str, content: Mapping[str, Any]) -> bool:
        nonlocal n_out
        if topic == schema.GRASP:
            return content["first_frame"] not in named
        out = topic == schema.FRAME and content["number"] not in left
        n_out += out
        return not out

    entries = messages.description.metadata | {
        THINNED: "frames of named parts and of no grasp are taken out"
    }
    if messages.lost_reason:
        entries[RECOVERED] = messages.lost_reason
    write_atomically(
        path,
        lambda file: write_messages(file, path, entries, stays),
        error=RecordingError,
        what="recording",
    )
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    return bool(n_out)


def thin_beside(path: Path) -> bool:
    """Run `thin` in a process of low priority: it takes minutes."""
    code = (
        "import os, pathlib, sys, cell.data.retention as r; os.nice(19); "
        "print(int(r.thin(pathlib.Path(sys.argv[1]))))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=False
    )
    if done.returncode:
        said = done.stderr.strip() or "its process was ended"
        raise RecordingError(said.splitlines()[-1].split("Error: ", 1)[-1])
    return done.stdout.strip() == "1"


class Retention:
    """Manages the disk of a recording; a missing or blocked disk stops nothing else.

    Parameters
    ----------
    recorder
        Writes the recording; it stops before the disk is full.
    folder
        Folder of all jobs.
    keep_s, keep_bytes
        Age in s and size in bytes beyond which the oldest recordings are deleted; None: no limit.
    at_fault
        Whether a fault is latched: its recording stays.
    note
        Gets messages for the operator.
    thin
        Thins out a recording, as `thin` does.
    monotonic_s, wall_s
        Both clocks in s.
    """

    def __init__(
        self,
        recorder: Recorder,
        folder: Path,
        *,
        keep_s: float | None = None,
        keep_bytes: float | None = None,
        at_fault: Callable[[], bool] = lambda: False,
        note: Callable[[str], None] = lambda _text: None,
        thin: Callable[[Path], bool] = thin_beside,
        monotonic_s: Callable[[], float] = time.monotonic,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        self._recorder, self._folder = recorder, folder
        self._keep_s = float("inf") if keep_s is None else keep_s
        self._keep_bytes = float("inf") if keep_bytes is None else keep_bytes
        self._at_fault, self._note, self._thin = at_fault, note, thin
        self._monotonic_s, self._wall_s = monotonic_s, wall_s
        self.short = ""
        """Remaining space as text for the operator; empty while there is enough."""
        self._of_fault: set[Path] = set()
        self._aged_s: float | None = None
        self._ledger: dict[str, Kept] = {}
        self._rate = 0.0
        self._sample = (monotonic_s(), recorder.n_bytes)
        self._refused = ""
        self._keeps = _JOB.fullmatch(recorder.path.parent.name) is not None
        self._over = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Check periodically, in a separate thread, until `close`."""
        self._thread = threading.Thread(target=self._run, name="retention", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the checks; do not wait for a blocked one."""
        self._over.set()
        if self._thread is not None:
            self._thread.join(_CLOSE_TIMEOUT_S)

    def _run(self) -> None:
        self.enforce()
        while not self._over.wait(_LOOK_S):
            self.enforce()

    def enforce(self) -> None:
        """Delete recordings that are too old or too large; note, thin out or stop at low space."""
        self._keep_of_fault()
        refused = ""
        for act in (self._look_at_space, self._delete):
            try:
                act()
            except (OSError, CellError) as error:
                refused = refused or str(error)
        if refused and refused != self._refused:
            self._note(f"not all recordings in {self._folder} are managed: {refused}")
        self._refused = refused

    def _keep_of_fault(self) -> None:
        if self._at_fault():
            self._of_fault.add(self._recorder.path)
        else:
            self._of_fault.clear()

    def _delete(self) -> None:
        if not self._keeps:
            return
        self._age()
        entries = _entries(self._folder, self._ledger)
        total, gone = sum(one.n_bytes for one in entries), 0
        for one in entries:
            too_old = one.kept.age_s > self._keep_s
            if not (too_old or total > self._keep_bytes):
                continue
            if self._stays(one):
                continue
            one.path.unlink()
            with suppress(OSError):  # a report or a model is beside it
                one.path.parent.rmdir()
            total, gone = total - one.n_bytes, gone + 1
        if gone:
            self._note(
                f"{gone} of the oldest recordings are deleted, because of recording.keep_days or "
                "keep_gb; `tactile-cell recordings mark FILE` keeps a recording"
            )

    def _age(self) -> None:
        """Age the recordings by the time since the last check of any program."""
        now_s = self._monotonic_s()
        if self._aged_s is not None and now_s - self._aged_s < _AGE_S:
            return
        longest_s = _DAY_S if self._aged_s is None else now_s - self._aged_s
        try:
            earlier, looked_s = _read_ledger(self._folder)
        except CellError:
            earlier, looked_s = self._ledger, self._wall_s()
        older_s = min(max(0.0, self._wall_s() - looked_s), longest_s)
        self._ledger = {
            name: Kept(one.age_s + older_s, one.thinned or self._of(name).thinned)
            for name, one in earlier.items()
        }
        self._aged_s = now_s
        self._write_ledger()

    def _of(self, name: str) -> Kept:
        return self._ledger.get(name, Kept())

    def _write_ledger(self) -> None:
        present = {_name(self._folder, path) for path in _paths(self._folder)}
        self._ledger = {name: self._of(name) for name in sorted(present)}
        content = {
            "looked_s": self._wall_s(),
            "recordings": {name: asdict(one) for name, one in self._ledger.items()},
        }
        with suppress(CellError):  # a full disk: this program continues with its own values
            write_json(self._folder / LEDGER, RETENTION, content, error=CellError)

    def _stays(self, one: Entry) -> bool:
        return one.marked or one.path in self._of_fault or in_use(one.path)

    def _look_at_space(self) -> None:
        free = free_bytes(self._recorder.path.parent)
        left_s = max(0, free - STOP_BYTES) / self._measured_rate()
        if left_s < THIN_S and self._keeps:
            self._thin_one(free)
        if free < STOP_BYTES:
            if self._recorder.fault is None:
                self._recorder.stop_reason = (
                    f"{free >> 20} MB are free, at least {STOP_BYTES >> 20} MB are left to others"
                )
        elif left_s < NOTE_S and not self.short:
            self._note(
                f"the disk of {self._folder} has space for {left_s / 60:.0f} min of recording, "
                f"{free >> 20} MB; free some, or lower recording.keep_gb"
            )
        if left_s < NOTE_S:
            self.short = f"space for {left_s / 60:.0f} min"
        elif left_s > _RELIEF * NOTE_S:
            self.short = ""

    def _measured_rate(self) -> float:
        """Return the bytes a second of the fastest minute so far."""
        (then_s, n_then), now_s, n_now = self._sample, self._monotonic_s(), self._recorder.n_bytes
        if now_s - then_s >= _RATE_S:
            self._rate = max(self._rate, (n_now - n_then) / (now_s - then_s))
            self._sample = (now_s, n_now)
        return self._rate or _FIRST_RATE

    def _thin_one(self, free: int) -> None:
        """Thin out the oldest recording that has room beside it for the result."""
        for one in _entries(self._folder, self._ledger):
            if one.kept.thinned or one.n_bytes > free or self._stays(one):
                continue
            name = _name(self._folder, one.path)
            self._ledger[name] = Kept(one.kept.age_s, thinned=True)
            try:
                if self._thin(one.path):
                    self._note(f"{one.path} is thinned out: frames of named parts are removed")
            except RecordingError as error:
                self._note(f"{one.path} is not thinned out: {error}")
            self._write_ledger()
            return


def _mark_of(path: Path) -> Path:
    return path.with_name(path.name + MARK)


def _name(folder: Path, path: Path) -> str:
    return path.relative_to(folder).as_posix()


def _paths(folder: Path) -> Iterator[Path]:
    """Yield the recordings of all jobs. Raises OSError if the folder is gone."""
    for job in os.scandir(folder):
        if _JOB.fullmatch(job.name) and job.is_dir(follow_symlinks=False):
            yield from Path(job.path).glob("recording*.mcap")


def _entries(folder: Path, ledger: dict[str, Kept]) -> list[Entry]:
    found = []
    for path in _paths(folder):
        with suppress(FileNotFoundError):
            stat, kept = path.stat(), ledger.get(_name(folder, path), Kept())
            entry = Entry(
                path=path, n_bytes=stat.st_size, marked=_mark_of(path).exists(), kept=kept
            )
            found.append(((-kept.age_s, stat.st_mtime_ns, path.name), entry))
    return [entry for _, entry in sorted(found, key=lambda one: one[0])]


def _read_ledger(folder: Path) -> tuple[dict[str, Kept], float]:
    """Return the ages, and the unix time in s of the last check; empty without a file.

    Raises CellError if they cannot be read.
    """
    path = folder / LEDGER
    values: dict[str, Any] | None = read_json(path, RETENTION, error=CellError)
    if values is None:
        return {}, float("inf")
    try:
        return _LEDGER.validate_python(values["recordings"]), float(values["looked_s"])
    except (ValidationError, KeyError, TypeError, ValueError) as error:
        raise CellError(f"{path} is damaged: {error}; {RETENTION.remedy}") from error
