"""Recordings by age, size and space: what goes, what stays, and that nothing stops the cell."""

import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cell.control.journal import Journal
from cell.control.states import CellState, GraspState
from cell.data import recorder as recorder_module, recorder_sink, retention
from cell.data.recorder import CONTINUES, Recorder
from cell.data.recording_reader import read_recording
from cell.data.retention import LEDGER, Retention, mark, recordings, thin, thin_beside, unmark
from cell.errors import RecordingError
from cell.service.history import History
from recognition.recognizer import Posterior
from tests.cell.conftest import call
from tests.cell.data.test_recording import PADS, record_grasp
from tests.fuzz.harness import Clock
from tests.values import make_identification, raising

DAY_S = 86_400.0
NOW_S = 1.8e9
"""Unix time in s at which the tests begin."""


class Keeper:
    """A recording in a folder of jobs, its retention, and the clocks and disk of both."""

    def __init__(self, folder: Path, **limits: Any) -> None:
        self.clock, self.wall_s, self.notes = Clock(100.0), NOW_S, list[str]()
        self.fault = False
        self.folder = folder
        job = folder / "serve-20270115-080000"
        job.mkdir(parents=True)
        self.recorder = Recorder(
            job / "recording.mcap", self.clock, pads=PADS, note=self.notes.append
        )
        self.limits = limits
        self.restart()

    def restart(self) -> None:
        """Begin the program anew, as far as its retention goes."""
        self.retention = Retention(
            self.recorder,
            self.folder,
            at_fault=lambda: self.fault,
            note=self.notes.append,
            monotonic_s=self.clock.monotonic,
            wall_s=lambda: self.wall_s,
            **self.limits,
        )

    def job(self, number: int, n_bytes: int = 1000) -> Path:
        """Add the recording of an earlier job."""
        path = self.folder / f"sort-2027010{number}-080000" / "recording.mcap"
        path.parent.mkdir()
        path.write_bytes(bytes(n_bytes))
        os.utime(path, (number, number))
        return path

    def live(self, days: float, *, step_s: float = 3600.0) -> None:
        """Let both clocks go on, with a look now and then."""
        for _ in range(round(days * DAY_S / step_s)):
            self.wall_s += step_s
            self.clock.now_s += step_s
            self.retention.enforce()


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
    found = lambda _folder: SimpleNamespace(f_bavail=free[0], f_frsize=1)  # noqa: E731
    monkeypatch.setattr(recorder_sink.os, "statvfs", found)
    return free


def test_recordings_go_by_age_and_size_oldest_first_and_marked_ones_stay(keep) -> None:
    keeper = keep(keep_s=3 * DAY_S, keep_bytes=5000)
    first, second, marked, newest = (keeper.job(number) for number in range(1, 5))
    mark(marked)
    (first.parent / "report.html").touch()
    keeper.live(2.0)
    assert all(path.exists() for path in (first, second, marked, newest))
    late = keeper.job(5, n_bytes=3000)
    keeper.live(1 / 24)
    # Together more than 5000 bytes: the oldest go, each with its folder where nothing else is.
    assert [path.exists() for path in (first, second, marked, newest, late)] == [
        False, False, True, False, True,
    ]  # fmt: skip
    assert (first.parent.exists(), second.parent.exists()) == (True, False)
    assert "`tactile-cell recordings mark FILE` keeps a recording" in keeper.notes[-1]
    keeper.live(3.2)
    assert (marked.exists(), late.exists()) == (True, False)
    assert keeper.recorder.path.exists()  # as old as these, and written to
    unmark(marked)
    keeper.live(1 / 24)
    assert not marked.exists()
    assert len(keeper.notes) == 3


@pytest.mark.parametrize("leap_s", [365 * DAY_S, -20 * 365 * DAY_S])
@pytest.mark.parametrize("stopped", [False, True])
def test_a_clock_that_leaps_makes_no_recording_old(keep, leap_s, stopped) -> None:
    keeper = keep(keep_s=30 * DAY_S)
    paths = [keeper.job(number) for number in range(1, 5)]
    keeper.live(10.0)
    keeper.wall_s += leap_s
    if stopped:
        keeper.restart()
    keeper.live(10.0)
    assert all(path.exists() for path in paths)
    keeper.live(11.0)
    assert not any(path.exists() for path in paths)


def test_two_programs_in_one_folder_count_each_day_once(keep) -> None:
    keeper = keep(keep_s=30 * DAY_S)
    path = keeper.job(1)
    first = keeper.retention
    first.enforce()
    keeper.restart()
    for _ in range(20):
        keeper.live(1.0)
        first.enforce()
    assert 19 < recordings(keeper.folder)[0].kept.age_s / DAY_S < 21.5
    assert path.exists()


def test_the_recording_of_an_open_fault_stays(keep) -> None:
    keeper = keep(keep_s=2 * DAY_S)
    at_fault = keeper.recorder.path
    keeper.fault = True
    keeper.retention.enforce()
    # Days later the person has not come yet, and the recording has gone on in other files.
    for _ in range(5):
        keeper.live(1.1)
        keeper.recorder.check()
        keeper.recorder.check()
    assert keeper.recorder.path != at_fault
    assert at_fault.exists()
    assert not (at_fault.parent / "recording-2.mcap").exists() or keeper.fault
    keeper.fault = False
    keeper.live(0.1)
    assert not at_fault.exists()
    assert keeper.recorder.path.exists()


def test_only_recordings_in_folders_of_jobs_are_looked_after(keep) -> None:
    keeper = keep(keep_s=1 * DAY_S, keep_bytes=1)
    own = [keeper.folder / "mine" / "recording.mcap", keeper.job(1).with_name("other.mcap")]
    for path in own:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (keeper.folder / "run-20270101-000000").symlink_to(own[0].parent)
    keeper.live(3.0)
    assert all(path.exists() for path in own)


def test_a_long_recording_goes_on_in_a_new_file_without_a_gap(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(recorder_module, "PART_BYTES", 20_000)
    clock, answer = Clock(100.0), make_identification(
        Posterior(labels=("a", "b"), probability=np.array([0.99, 0.01]), unknown=0.0)
    )  # fmt: skip
    with Recorder(tmp_path / "recording.mcap", clock, pads=PADS, background=True) as recorder:
        Journal(recorder).states(CellState.IDLE, GraspState.IDLE)
        for number in range(30):
            record_grasp(recorder, clock, f"{number}")
            Journal(recorder).result(answer)
            recorder._parting.join(10.0) if recorder._parting.ident else None
    paths = sorted(tmp_path.iterdir(), key=lambda path: (len(path.name), path.name))
    assert len(paths) >= 3
    read = [read_recording(path) for path in paths]
    assert all(one.complete and not one.n_broken_grasps for one in read)
    grasps = [grasp.label for one in read for grasp in one.grasps]
    assert grasps == [f"{number}" for number in range(30)]
    assert [one.metadata.get(CONTINUES) for one in read[1:]] == [path.name for path in paths[:-1]]
    assert all(one.states[0]["state"] == "IDLE" for one in read)


def test_an_hour_of_space_is_noted_then_recordings_are_thinned_then_it_stops_and_goes_on(
    keep, disk
) -> None:
    keeper = keep()
    old = keeper.job(1)
    old.unlink()
    record_named_and_unknown(old)
    keeper.live(0.02, step_s=60.0)
    assert (keeper.notes, keeper.retention.short) == ([], "")
    rate = retention._FIRST_RATE
    disk[0] = retention.STOP_BYTES + int(3000 * rate)
    keeper.live(0.02, step_s=60.0)
    (note,) = keeper.notes
    assert "space for 50 min of recording" in note
    assert keeper.retention.short == "space for 50 min"
    disk[0] = retention.STOP_BYTES + int(1000 * rate)
    keeper.live(0.02, step_s=60.0)
    assert keeper.notes[1:] == [f"{old} is thinned out: frames of named parts are removed"]
    assert [one.path for one in recordings(keeper.folder) if one.kept.thinned] == [old]
    disk[0] = retention.STOP_BYTES - 1
    keeper.retention.enforce()
    record_grasp(keeper.recorder, keeper.clock, "last")
    assert "stopped after 0 frames: 7 MB are free" in str(keeper.recorder.fault)
    assert read_recording(keeper.recorder.path).complete
    keeper.live(0.02, step_s=60.0)
    keeper.recorder.check()
    assert keeper.recorder.fault is not None
    disk[0] = 100 << 30
    keeper.live(0.02, step_s=60.0)
    keeper.recorder.check()
    assert keeper.recorder.fault is None
    assert keeper.recorder.path.name == "recording-2.mcap"
    assert keeper.retention.short == ""
    with pytest.raises(RecordingError, match="a gap of 20 frames"):
        keeper.recorder.close()


def record_named_and_unknown(path: Path) -> None:
    """Record a named part of two grasps, one without a name, and a taught grasp."""
    clock = Clock(100.0)
    with Recorder(path, clock, pads=PADS) as recorder:
        for label, p, unknown, n in (("named", 0.999, 0.0, 2), ("strange", 0.5, 1.0, 1)):
            likely = Posterior(labels=("a", "b"), probability=np.array([p, 1 - p]), unknown=unknown)
            for _ in range(n):
                record_grasp(recorder, clock, label)
            records = (SimpleNamespace(early=None),) * n
            Journal(recorder).result(make_identification(likely, records=records))
        record_grasp(recorder, clock, "taught")


def test_thinning_takes_the_frames_of_named_parts_and_leaves_a_whole_recording(tmp_path) -> None:
    path = tmp_path / "recording.mcap"
    record_named_and_unknown(path)
    before = read_recording(path)
    assert thin(path)
    after = read_recording(path)
    assert after.complete
    assert after.n_broken_grasps == 0
    assert "frames of named parts" in after.metadata[retention.THINNED]
    assert after.results == before.results
    assert len(after.cycles) == len(before.cycles)
    assert [grasp.label for grasp in after.grasps] == ["strange", "taught"]
    assert len(after.frames) == sum(grasp.n_frames for grasp in after.grasps)
    assert not thin_beside(path)
    path.write_bytes(b"no recording")
    with pytest.raises(RecordingError, match="is not a recording"):
        thin_beside(path)


def test_a_share_that_disappears_is_noted_once_and_stops_nothing(keep, monkeypatch) -> None:
    keeper = keep(keep_s=DAY_S)
    with monkeypatch.context() as patched:
        for name in ("statvfs", "scandir"):
            patched.setattr(os, name, raising(OSError(116, "Stale file handle")))
        keeper.live(1.0)
    assert len(keeper.notes) == 1
    assert "Stale file handle" in keeper.notes[0]
    (keeper.folder / LEDGER).write_text("no list of ours")
    keeper.live(1.0)
    assert recordings(keeper.folder)


def test_a_disk_that_does_not_answer_holds_up_neither_start_nor_end(keep, monkeypatch) -> None:
    import threading

    keeper, answers = keep(), threading.Event()
    monkeypatch.setattr(retention, "_CLOSE_TIMEOUT_S", 0.0)
    monkeypatch.setattr(retention, "free_bytes", lambda _folder: answers.wait(10.0) or 0)
    keeper.retention.start()
    keeper.retention.close()
    assert keeper.retention._thread.is_alive()
    answers.set()
    keeper.retention._thread.join(10.0)
    assert not keeper.retention._thread.is_alive()


@pytest.mark.skipif(os.geteuid() != 0, reason="mounting needs root")
def test_a_tmpfs_that_fills_and_empties(tmp_path) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    mounted = ["mount", "-t", "tmpfs", "-o", "size=40m", "none", str(place)]
    if subprocess.run(mounted, check=False).returncode:
        pytest.skip("mount is not allowed here")
    try:
        keeper, filling = Keeper(place / "out"), place / "filling"
        keeper.retention.enforce()
        assert "min of recording" in keeper.notes[0]
        record_grasp(keeper.recorder, keeper.clock, "before")
        filling.write_bytes(bytes(36 << 20))
        keeper.retention.enforce()
        keeper.recorder.check()
        assert "stopped after 20 frames" in str(keeper.recorder.fault)
        with filling.open("ab") as file, pytest.raises(OSError, match="No space"):
            file.write(bytes(36 << 20))
        status: Any = SimpleNamespace(n_faults=0, fault=None, fault_number=0)
        history = History(place / "history.sqlite3", lambda: status, note=keeper.notes.append)
        history.update()
        assert "the history is not kept" in keeper.notes[-1]
        keeper.live(0.1)
        keeper.recorder.check()
        assert keeper.recorder.fault is not None
        filling.unlink()
        history.update()
        assert history.values()["today"]["starts"] == 1
        history._close_link()
        keeper.clock.now_s += 1.0
        keeper.recorder.check()
        record_grasp(keeper.recorder, keeper.clock, "after")
        paths = sorted(place.glob("out/serve-*/*.mcap"), key=lambda path: path.stat().st_ino)
        with pytest.raises(RecordingError, match="a gap of 0 frames"):
            keeper.recorder.close()
        read = [read_recording(path) for path in paths]
        labels = [grasp.label for one in read for grasp in one.grasps]
        assert (labels, all(one.complete for one in read)) == (["before", "after"], True)
    finally:
        subprocess.run(["umount", place], check=True)


def test_recordings_are_listed_and_marked_by_commands(keep) -> None:
    keeper = keep()
    path = keeper.job(1, n_bytes=2_000_000)
    assert call("recordings", "mark", path) == f"{path}: marked\n"
    keeper.live(2.0)
    listed = call("recordings", "list", keeper.folder).splitlines()
    assert f"  {path}: MB 2.0, age / days 2.0, marked yes" in listed
    assert call("recordings", "unmark", path) == f"{path}: not marked\n"
    assert "marked yes" not in call("recordings", "list", keeper.folder)
    with pytest.raises(RecordingError, match="is not a recording"):
        mark(keeper.folder)
