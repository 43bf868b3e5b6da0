import gc
import signal
import sys
import threading
import time
import weakref
from collections.abc import Iterator

import pytest

from cell.errors import CellStateError
from cell.plugin.worker import JOB_SILENT_S, CellWorker, Job, JobOutcome, Report


@pytest.fixture
def worker() -> Iterator[CellWorker]:
    made = CellWorker(idle=lambda: None, idle_period_s=None)
    yield made
    made.close(5.0)


def test_jobs_of_others_and_closed_worker_are_refused(worker: CellWorker) -> None:
    with pytest.raises(CellStateError, match="no job 77"):
        worker.status(Job(77, "another"))
    other = CellWorker(idle=lambda: None, idle_period_s=None)
    ours, theirs = (each.start(lambda _report: None) for each in (worker, other))
    assert ours.number == theirs.number
    for ask in (worker.status, lambda job: worker.wait(job, 0.0)):
        with pytest.raises(CellStateError, match="no job 1 in this cell"):
            ask(theirs)
    other.close(5.0)
    with pytest.raises(CellStateError, match="closed"):
        other.start(lambda _report: None)


def test_what_is_started_while_the_end_is_awaited_is_refused() -> None:
    looking, go_on = threading.Event(), threading.Event()

    def idle() -> None:
        looking.set()
        go_on.wait(10.0)

    worker = CellWorker(idle=idle, idle_period_s=0.001)
    assert looking.wait(10.0)
    with pytest.raises(TimeoutError, match="has not ended after 0 s"):
        worker.close(0.0)
    with pytest.raises(CellStateError, match="closed"):
        worker.start(lambda _report: None)
    go_on.set()
    worker.close(10.0)


def test_every_job_that_is_accepted_beside_a_close_ends() -> None:
    for _ in range(50):
        worker = CellWorker(idle=lambda: None, idle_period_s=None)
        accepted, first = [], threading.Event()

        def start(worker=worker, accepted=accepted, first=first) -> None:
            while True:
                try:
                    accepted.append(worker.start(lambda _report: None))
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


def test_a_job_cannot_wait_for_its_own_end(worker: CellWorker) -> None:
    status = worker.wait(worker.start(lambda _report: worker.close(5.0)), 10.0)
    assert isinstance(status.exception, CellStateError)
    assert "close from another thread" in status.error
    assert worker.wait(worker.start(lambda _report: "goes on"), 10.0).value == "goes on"


def test_a_thread_that_is_stuck_between_jobs_does_not_work() -> None:
    looking, go_on = threading.Event(), threading.Event()
    worker = CellWorker(idle=lambda: (looking.set(), go_on.wait(10.0)), idle_period_s=0.001)
    assert looking.wait(10.0)
    assert worker.working
    worker.looked_s -= 60.0
    assert not worker.working
    worker.start(lambda _report: None)
    assert worker.working  # it has a job
    go_on.set()
    worker.close(10.0)


@pytest.mark.parametrize("way", ["report", "period"])
def test_a_job_has_a_longest_time_without_progress(way: str) -> None:
    go_on, over = threading.Event(), threading.Event()
    moved_s = [0.0]

    def hangs(report: Report) -> None:
        go_on.wait(10.0)
        report({"grasps": 1})
        reported.set()
        over.wait(10.0)

    reported = threading.Event()
    worker = CellWorker(idle=lambda: None, idle_period_s=None, progressed_s=lambda: moved_s[0])
    job = worker.start(hangs)
    while worker.status(job).outcome is not JobOutcome.EXECUTING:
        go_on.wait(0.001)
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
    worker.close(10.0)


@pytest.mark.slow
def test_a_worker_that_nobody_uses_is_collected_and_its_thread_ends() -> None:
    worker = CellWorker(idle=lambda: None, idle_period_s=0.001)
    worker.wait(worker.start(lambda _report: None), 10.0)
    thread, gone = worker._thread, weakref.ref(worker)
    del worker
    gc.collect()
    thread.join(10.0)
    assert not thread.is_alive()
    assert gone() is None


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
        status = worker.wait(worker.start(job), 20.0)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert status.value is True
