"""The thread of a cell with its jobs; a host that falls silent; the levels of health."""

import re
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from cell.control.states import CellState
from cell.errors import CellStateError, RecordingError
from cell.recording import retention
from cell.recording.reader import read_recording
from cell.runtime.goals import TeachGoal
from cell.runtime.health import health_values
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.worker import JOB_SILENT_S, CellWorker, Job, JobFailed, JobOutcome, Lease, Report
from tests.cell.cells import quick_config, small_config
from tests.cell.recording.test_recording import fill_disk_after
from tests.cell.served import LIMIT_S, until
from tests.fuzz.harness import Clock


@pytest.fixture
def make_worker(undo: ExitStack) -> Callable[..., CellWorker]:
    """Return the maker of workers, by default without supervision; they end with the test."""

    def make(**options: Any) -> CellWorker:
        made = CellWorker(**{"idle": lambda: None, "idle_period_s": None} | options)
        undo.callback(made.close, 10.0)
        return made

    return make


@pytest.fixture
def worker(make_worker: Any) -> CellWorker:
    return make_worker()


def test_jobs_of_others_and_closed_worker_are_refused(worker, make_worker) -> None:
    with pytest.raises(CellStateError, match="no job 77"):
        worker.status(Job(number=77, worker="another"))
    other = make_worker()
    ours, theirs = (each.start("work", lambda _report: None) for each in (worker, other))
    assert ours.number == theirs.number
    for ask in (worker.status, lambda job: worker.wait(job, 0.0)):
        with pytest.raises(CellStateError, match="no job 1 in this cell"):
            ask(theirs)
    other.close(5.0)
    with pytest.raises(CellStateError, match="closed"):
        other.start("work", lambda _report: None)


def stuck(make_worker: Any) -> tuple[CellWorker, threading.Event]:
    """Return a worker whose thread hangs between jobs, and what lets it go on."""
    looking, go_on = threading.Event(), threading.Event()
    worker = make_worker(idle=lambda: (looking.set(), go_on.wait(10.0)), idle_period_s=0.001)
    assert looking.wait(10.0)
    return worker, go_on


def test_what_is_started_while_the_end_is_awaited_is_refused(make_worker) -> None:
    worker, go_on = stuck(make_worker)
    with pytest.raises(TimeoutError, match="has not ended after 0 s"):
        worker.close(0.0)
    with pytest.raises(CellStateError, match="closed"):
        worker.start("work", lambda _report: None)
    go_on.set()


def test_every_job_that_is_accepted_beside_a_close_ends(make_worker) -> None:
    for _ in range(50):
        worker = make_worker()
        accepted, first = [], threading.Event()

        def start(worker=worker, accepted=accepted, first=first) -> None:
            while True:
                try:
                    accepted.append(worker.start("work", lambda _report: None))
                except CellStateError as error:
                    if "closed" in str(error):
                        return
                first.set()

        starter = threading.Thread(target=start)
        starter.start()
        assert first.wait(10.0)
        worker.close(10.0)
        starter.join(10.0)
        assert all(worker.status(job).outcome is JobOutcome.SUCCEEDED for job in accepted)


def test_a_thread_that_is_stuck_between_jobs_does_not_work(make_worker) -> None:
    worker, go_on = stuck(make_worker)
    assert worker.working
    worker.looked_s -= 60.0
    assert not worker.working
    worker.start("work", lambda _report: None)
    assert worker.working  # it has a job
    go_on.set()


@pytest.mark.parametrize("way", ["report", "period"])
def test_a_job_has_a_longest_time_without_progress(make_worker, way: str) -> None:
    go_on, reported, over = (threading.Event() for _ in range(3))
    moved_s = [0.0]

    def hangs(report: Report) -> None:
        go_on.wait(10.0)
        report({"grasps": 1})
        reported.set()
        over.wait(10.0)

    worker = make_worker(progressed_s=lambda: moved_s[0])
    job = worker.start("work", hangs)
    until(lambda: worker.status(job).outcome is JobOutcome.EXECUTING)
    worker.looked_s -= JOB_SILENT_S - 1.0
    assert worker.working
    worker.looked_s -= 2.0
    assert not worker.working
    if way == "report":
        go_on.set()
        assert reported.wait(10.0)
    else:
        moved_s[0] = time.monotonic()
    assert worker.working
    go_on.set()
    over.set()


def test_a_wait_answers_a_signal_that_another_thread_got(worker: CellWorker) -> None:
    answered, started = threading.Event(), threading.Event()

    def job(_report: object) -> bool:
        main = threading.main_thread().ident or 0
        while sys._current_frames()[main].f_code is not threading.Condition.wait.__code__:
            started.wait(0.001)
        started.wait(0.01)
        signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)
        return answered.wait(10.0)

    before = signal.signal(signal.SIGUSR1, lambda *_given: answered.set())
    try:
        status = worker.wait(worker.start("work", job), 20.0)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert status.value is True


# -- A host that falls silent while a job runs -----------------------------------------------------


def test_a_silence_is_told_once_and_again_after_the_host_was_heard() -> None:
    clock, silences = Clock(), []
    lease = Lease(3600.0, given=lambda _name: None, lost=silences.append, clock=clock)

    def look(now_s: float) -> list[str]:
        clock.now_s = now_s
        lease.has(0)
        return [re.findall(r"[0-9.]+", text)[0] for text in silences]

    assert look(1.0) == []
    with lease.calling("host"):
        pass
    assert look(3601.0) == []
    assert look(3602.0) == look(9000.0) == ["3601.00"]
    with lease.calling("host"), lease.calling("host"):
        pass
    with lease.calling("host"):
        assert look(20_000.0) == ["3601.00"]  # a host that waits in a call is there
    assert look(23_600.0) == ["3601.00"]
    assert look(23_601.0) == ["3601.00", "3601.00"]


@pytest.mark.slow
def test_a_silence_stops_the_job_that_runs_alone_and_its_end_can_be_read() -> None:
    with TactileCellPlugin(quick_config(host_timeout_s=0.2)) as plugin:
        life = plugin.cell.controller.life
        plugin.alive()
        until(lambda: not plugin._lease.number)
        assert not life.cancelled
        job = plugin.start(TeachGoal(label="ball", grasps=1000))
        until(lambda: not plugin._worker.running)
        status = plugin.feedback(job)
        assert status.outcome is JobOutcome.CANCELED
        assert "stopped because 'the host' was silent for 0." in status.error
        assert life.state in (CellState.HELD, CellState.IDLE)
        with pytest.raises(JobFailed, match="'the host' was silent"):
            plugin.result(job, 1.0)
        if life.state is CellState.HELD:
            plugin.release(LIMIT_S)
        assert plugin.status().state_number == CellState.IDLE.number


def test_each_call_of_the_host_is_heard() -> None:
    with TactileCellPlugin(quick_config(host_timeout_s=1000.0)) as plugin:
        for call in (plugin.alive, plugin.status, plugin.forget_drift):
            plugin._lease._heard_s = -1.0
            call()
            assert plugin._lease._heard_s > 0.0, call


def test_a_lost_recording_holds_the_grasp_where_the_config_says_so_until_there_is_room(
    make_bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_bench(quick_config(recording__when_lost="hold"), folder=tmp_path).ready()
    room = fill_disk_after(monkeypatch, 0)
    with pytest.raises(RecordingError, match="No space left"):
        bench.grasp(6.0)
    assert bench.controller.life.state is CellState.ABORTED
    assert "No space left" in bench.cell.health()["recording"]
    health = health_values(bench.config, bench.cell, None)["recording"]
    assert (health["level"], health["path"]) == ("bad", str(tmp_path / "recording.mcap"))
    room[0] = 1 << 40
    bench.life.clear()
    bench.controller.release_held()
    bench.life.reset()
    bench.controller.start()
    bench.grasp(6.0)
    assert bench.cell.health()["recording"] is None
    health = health_values(bench.config, bench.cell, None)["recording"]
    assert (health["level"], health["path"]) == ("ok", str(tmp_path / "recording-2.mcap"))
    bench.cell.close()
    assert len(read_recording(tmp_path / "recording-2.mcap").grasps) == 1


# -- Health of a cell: its levels follow the limits of the config ----------------------------------


@pytest.mark.parametrize(
    ("limit", "level"),
    [({}, "ok"), ({"current_max_a": 9.0}, "watch"), ({"temperature_max_c": 20.0}, "bad")],
    ids=str,
)
def test_heat_is_judged_by_the_limit_and_where_the_current_is_lowered(
    make_bench, limit: dict[str, float], level: str
) -> None:
    bench = make_bench().ready()
    config = bench.config.model_copy(
        update={"gripper": bench.config.gripper.model_copy(update=limit)}
    )
    assert health_values(config, bench.cell, None)["servos"]["level"] == level


def test_lost_frames_are_judged_by_their_limit(make_bench) -> None:
    bench = make_bench(small_config(tactile__loss_max_share=0.5)).ready()
    assert health_values(bench.config, bench.cell, None)["can"]["level"] == "ok"
    bench.simulated.inject("can.lose_next=12")
    bench.idle(0.25)
    can = health_values(bench.config, bench.cell, None)["can"]
    assert can["level"] == "watch"
    strict = small_config(tactile__loss_max_share=0.001)
    assert health_values(strict, bench.cell, None)["can"]["level"] == "bad"


def test_too_little_space_for_the_recording_is_watched(make_bench, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "free_bytes", lambda _folder: 18_000_000)
    folder, notes = tmp_path / "run-20270115-080000", list[str]()
    folder.mkdir()
    config = small_config(recording__keep_gb=2.0)
    cell = make_bench(config, folder=folder, note=notes.append).cell
    until(lambda: cell.recording_problem)
    recording = health_values(config, cell, None)["recording"]
    assert (recording["level"], [recording["text"]]) == ("watch", notes)
    assert notes[0].startswith(f"the disk of {tmp_path} has less than 500 MB free")
    assert cell._retention._keep_bytes == 2e9
