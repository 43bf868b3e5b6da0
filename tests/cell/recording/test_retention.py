"""Recordings by size and space: what goes, what stays, and that nothing stops the cell."""

import errno
import os
import threading
from collections.abc import Iterator
from contextlib import closing
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from cell.errors import RecordingError
from cell.recording import retention, sink as recorder_sink
from cell.recording.recorder import Recorder
from cell.recording.retention import LEAST_FREE_BYTES, Retention, mark, recordings, unmark
from tests.cell.conftest import call
from tests.cell.recording.test_recording import PADS
from tests.fuzz.harness import Clock
from tests.values import raising


class Keeper:
    """A recording in a folder of jobs, and its retention."""

    def __init__(self, folder: Path, **limits: Any) -> None:
        self.clock, self.notes = Clock(100.0), list[str]()
        self.folder = folder
        job = folder / "serve-20270115-080000"
        job.mkdir(parents=True)
        self.recorder = Recorder(
            job / "recording.mcap", self.clock, pads=PADS, note=self.notes.append
        )
        self.retention = Retention(self.recorder, folder, note=self.notes.append, **limits)

    def job(self, number: int, n_bytes: int = 1000) -> Path:
        """Add the recording of an earlier job."""
        path = self.folder / f"sort-2027010{number}-080000" / "recording.mcap"
        path.parent.mkdir()
        path.write_bytes(bytes(n_bytes))
        os.utime(path, (number, number))
        return path


@pytest.fixture
def keep(tmp_path: Path) -> Iterator[Any]:
    made = list[Keeper]()

    def make(**limits: Any) -> Keeper:
        made.append(Keeper(tmp_path / "out", **limits))
        return made[-1]

    yield make
    for keeper in made:
        keeper.recorder.close()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return the free bytes of the disk, to be changed."""
    free = [100 << 30]
    space = lambda _folder: SimpleNamespace(f_bavail=free[0], f_frsize=1)  # noqa: E731
    monkeypatch.setattr(recorder_sink.os, "statvfs", space)
    return free


def test_the_oldest_recordings_go_by_size_and_marked_ones_stay(keep) -> None:
    keeper = keep(keep_bytes=5000)
    first, second, marked, newest = (keeper.job(number) for number in range(1, 5))
    mark(marked)
    (first.parent / "report.html").touch()
    keeper.retention.enforce()
    assert all(path.exists() for path in (first, second, marked, newest))
    late = keeper.job(5, n_bytes=3000)
    keeper.retention.enforce()
    # Together more than 5000 bytes: the oldest go, each with its folder where nothing else is.
    assert [path.exists() for path in (first, second, marked, newest, late)] == [
        False, False, True, False, True,
    ]  # fmt: skip
    assert (first.parent.exists(), second.parent.exists()) == (True, False)
    (note,) = keeper.notes
    assert note.startswith("3 of the oldest recordings are deleted")
    assert "`tactile-cell recording mark FILE` keeps a recording" in note
    unmark(marked)
    keeper.job(6)
    keeper.retention.enforce()
    assert not marked.exists()
    assert late.exists()


def test_the_oldest_recordings_go_while_the_disk_is_short_of_space(keep, disk) -> None:
    keeper = keep()
    first, second, third = (keeper.job(number) for number in range(1, 4))
    disk[0] = LEAST_FREE_BYTES
    keeper.retention.enforce()
    assert first.exists()
    disk[0] = LEAST_FREE_BYTES - 1500
    keeper.retention.enforce()
    assert [path.exists() for path in (first, second, third)] == [False, False, True]
    assert (len(keeper.notes), keeper.retention.problem) == (1, "")
    mark(third)
    for _ in range(2):
        keeper.retention.enforce()
    assert keeper.notes[1:] == [keeper.retention.problem]
    assert "has less than 500 MB free, and no recording can be deleted" in keeper.notes[1]
    disk[0] = LEAST_FREE_BYTES
    keeper.retention.enforce()
    assert keeper.retention.problem == ""
    assert third.exists()


def test_the_recordings_that_programs_write_stay(keep, monkeypatch) -> None:
    keeper = keep(keep_bytes=1)
    path, own = keeper.job(1), keeper.recorder.path
    path.unlink()
    os.utime(own, (0, 0))
    with closing(Recorder(path, keeper.clock, pads=PADS)):
        keeper.retention.enforce()
        assert path.exists()
    # Without locks only this program's recording is known to be open.
    monkeypatch.setattr(recorder_sink.fcntl, "flock", raising(OSError(errno.ENOLCK, "no locks")))
    keeper.retention.enforce()
    assert (path.exists(), own.exists()) == (False, True)


def test_only_recordings_in_folders_of_jobs_are_managed(keep) -> None:
    keeper = keep(keep_bytes=1)
    own = [keeper.folder / "mine" / "recording.mcap", keeper.job(1).with_name("other.mcap")]
    for path in own:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (keeper.folder / "run-20270101-000000").symlink_to(own[0].parent)
    keeper.retention.enforce()
    assert all(path.exists() for path in own)
    assert len(keeper.notes) == 1
    path = keeper.job(2)
    with closing(Recorder(keeper.folder / "x.mcap", keeper.clock, pads=PADS)) as outside:
        Retention(outside, keeper.folder, keep_bytes=1).enforce()
    assert path.exists()


def test_a_share_that_disappears_is_noted_once_and_stops_nothing(keep, monkeypatch) -> None:
    keeper = keep()
    with monkeypatch.context() as patched:
        for name in ("statvfs", "scandir"):
            patched.setattr(os, name, raising(OSError(116, "Stale file handle")))
        for _ in range(3):
            keeper.retention.enforce()
    assert len(keeper.notes) == 1
    assert "Stale file handle" in keeper.notes[0]
    keeper.retention.enforce()
    assert keeper.retention.problem == ""


def test_a_disk_that_does_not_answer_holds_up_neither_start_nor_end(keep, monkeypatch) -> None:
    keeper, answers = keep(), threading.Event()
    monkeypatch.setattr(retention, "_CLOSE_TIMEOUT_S", 0.0)
    monkeypatch.setattr(retention, "free_bytes", lambda _folder: answers.wait(10.0) or 0)
    keeper.retention.start()
    keeper.retention.close()
    assert keeper.retention._thread.is_alive()
    answers.set()
    keeper.retention._thread.join(10.0)
    assert not keeper.retention._thread.is_alive()


def test_recordings_are_listed_and_marked_by_commands(keep) -> None:
    keeper = keep()
    path = keeper.job(1, n_bytes=2_000_000)
    written_s = datetime(2027, 1, 15, 8, 30).timestamp()
    os.utime(path, (written_s, written_s))
    assert call("recording", "mark", path) == f"{path}: marked\n"
    listed = call("recording", "list", keeper.folder).splitlines()
    assert f"  {path}: MB 2.0, last write 2027-01-15 08:30, marked yes" in listed
    assert [one.marked for one in recordings(keeper.folder)] == [False, True]
    with pytest.raises(RecordingError, match="is not a recording"):
        mark(keeper.folder)
