import gc
import threading
import weakref
from collections.abc import Iterator

import pytest

from cell.errors import CellStateError, CellStopped
from cell.interfaces.plugin.worker import CellWorker, Job, JobOutcome, Report


@pytest.fixture
def worker() -> Iterator[CellWorker]:
    made = CellWorker(idle=lambda: None, idle_period_s=None)
    yield made
    made.close(5.0)


def test_start_does_not_wait_and_one_job_runs_at_a_time(worker: CellWorker) -> None:
    go_on = threading.Event()

    def work(report: Report) -> str:
        report({"step": 1})
        go_on.wait(10.0)
        return "done"

    job = worker.start(work)
    with pytest.raises(CellStateError, match="is not over"):
        worker.start(work)
    with pytest.raises(TimeoutError, match="not over"):
        worker.wait(job, 0.0)
    go_on.set()
    status = worker.wait(job, 10.0)
    assert (status.outcome, status.value) == (JobOutcome.SUCCEEDED, "done")
    assert status.progress == {"step": 1}


def test_a_stopped_job_is_cancelled_a_failing_one_aborted(worker: CellWorker) -> None:
    def stopped(_report: Report) -> None:
        raise CellStopped("stopped on request")

    def failing(_report: Report) -> None:
        raise ValueError("no")

    assert worker.wait(worker.start(stopped), 10.0).outcome is JobOutcome.CANCELED
    status = worker.wait(worker.start(failing), 10.0)
    assert status.outcome is JobOutcome.ABORTED
    assert status.error == "ValueError: no"


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


def test_a_worker_that_nobody_uses_is_collected_and_its_thread_ends() -> None:
    worker = CellWorker(idle=lambda: None, idle_period_s=0.001)
    worker.wait(worker.start(lambda _report: None), 10.0)
    thread, gone = worker._thread, weakref.ref(worker)
    del worker
    gc.collect()
    thread.join(10.0)
    assert not thread.is_alive()
    assert gone() is None


def test_the_supervision_goes_on_after_an_error_and_jobs_run_all_the_same() -> None:
    calls: list[int] = []
    again = threading.Event()

    def idle() -> None:
        calls.append(1)
        if len(calls) > 1:
            again.set()
        raise RuntimeError("heartbeat lost")

    worker = CellWorker(idle=idle, idle_period_s=0.001)
    assert again.wait(10.0)
    assert worker.wait(worker.start(lambda _report: 7), 10.0).value == 7
    worker.close(5.0)
