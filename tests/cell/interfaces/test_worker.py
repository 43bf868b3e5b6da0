import threading
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


def test_unknown_job_and_closed_worker_are_refused(worker: CellWorker) -> None:
    with pytest.raises(CellStateError, match="no job 77"):
        worker.status(Job(77))
    other = CellWorker(idle=lambda: None, idle_period_s=None)
    other.close(5.0)
    with pytest.raises(CellStateError, match="closed"):
        other.start(lambda _report: None)


def test_idle_supervision_keeps_its_error() -> None:
    called = threading.Event()

    def idle() -> None:
        called.set()
        raise RuntimeError("heartbeat lost")

    worker = CellWorker(idle=idle, idle_period_s=0.001)
    assert called.wait(10.0)
    worker.close(5.0)
    assert str(worker.idle_error) == "heartbeat lost"
