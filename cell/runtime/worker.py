"""The worker: one thread that owns a cell, runs its jobs, and supervises it between jobs."""

import functools
import math
import queue
import threading
import time
import uuid
import weakref
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from cell.errors import CellError, CellStateError, CellStopped
from cell.fault_catalogue import error_text, fault_number

KEPT_JOBS = 100
"""Newest jobs whose status is kept, so that the memory of a resident program stays bounded."""
SIGNAL_LOOK_S = 0.02
"""Longest time in s that a waiting main thread leaves a signal unanswered.

The system may deliver a signal to any thread, but Python handles it only in the main thread.
"""

_SILENT_S = 10.0
"""Time in s without supervision after which the thread counts as stuck: twice the longest silence
of a force loop."""
JOB_SILENT_S = 300.0
"""Longest time in s of a job without a report, a period of a motion or the end of a move. Beside
the moves of a host, a training is the longest: 8 s for 720 grasps of 36 objects."""


class JobOutcome(StrEnum):
    """State of a job, in the terms of ROS 2 actions."""

    ACCEPTED = "ACCEPTED"
    EXECUTING = "EXECUTING"
    SUCCEEDED = "SUCCEEDED"
    CANCELED = "CANCELED"
    ABORTED = "ABORTED"

    @property
    def terminal(self) -> bool:
        """Whether the job is over."""
        return self in (JobOutcome.SUCCEEDED, JobOutcome.CANCELED, JobOutcome.ABORTED)


@dataclass(frozen=True, slots=True)
class Job:
    """Handle of a started job."""

    number: int
    """Its number among the jobs of its worker, from 1."""
    worker: str
    """Name of its worker: jobs of two cells have the same numbers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JobStatus:
    """State and progress of a job."""

    outcome: JobOutcome
    """Its state."""
    progress: dict[str, Any]
    """Its last report; the keys depend on the job."""
    value: Any = None
    """Its result after success."""
    error: str = ""
    """Why it failed, as text; else empty."""
    exception: BaseException | None = None
    """The error that ended it; None without an error."""

    @property
    def fault_number(self) -> int:
        """Number of the error in the fault catalogue; 0 without an error."""
        return fault_number(self.exception)


class JobFailed(CellError):
    """A job was cancelled or aborted; ``__cause__`` is the error that ended it."""

    def __init__(self, job: Job, status: JobStatus) -> None:
        super().__init__(f"job {job.number} {status.outcome.value}: {status.error}")
        self.job = job
        self.outcome = status.outcome
        """``CANCELED`` or ``ABORTED``."""
        self.fault_number = status.fault_number
        """Number of the error that ended the job, in the fault catalogue."""


Report = Callable[[dict[str, Any]], None]


class CellWorker:
    """Runs jobs on its own thread, at most one at a time.

    The waiting thread has only a weak reference to its worker, so that an unused cell can be
    collected.
    """

    def __init__(
        self,
        *,
        idle: Callable[[], None],
        idle_period_s: float | None,
        progressed_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        """Start the thread.

        Parameters
        ----------
        idle
            Called on the thread once a period while no job runs.
        idle_period_s
            That period in s; None for a cell whose time stands still without a job. A function that
            `between_jobs` runs can change it.
        progressed_s
            Returns the monotonic time in s of the newest progress of a job, beside its reports.
        """
        self._idle, self._progressed_s = idle, progressed_s
        self.idle_period_s = idle_period_s
        self.looked_s = time.monotonic()
        """Monotonic time in s of the thread's last turn, or of the last report of its job."""
        self._queue: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._name = uuid.uuid4().hex
        self._refusing = False
        self._changed = threading.Condition()
        self._status: dict[Job, JobStatus] = {}
        self._newest = 0
        self._thread = threading.Thread(
            target=_serve,
            args=(weakref.ref(self), self._queue),
            name="tactile-cell",
            daemon=True,
        )
        self._thread.start()

    def start(
        self, work: Callable[[Report], Any], *, accepted: Callable[[Job], None] = lambda _job: None
    ) -> Job:
        """Accept a job; return at once.

        ``work`` gets a function to report its progress. ``accepted`` is called with the job before
        it runs and after other jobs have ended; an error that it raises refuses the job. Raises
        CellStateError if another job has not ended, or the cell is being closed.
        """
        with self._changed:
            self.check_free()
            job = Job(self._newest + 1, self._name)
            accepted(job)
            self._newest, self.looked_s = job.number, time.monotonic()
            self._status[job] = JobStatus(outcome=JobOutcome.ACCEPTED, progress={})
            if len(self._status) > KEPT_JOBS:
                del self._status[next(iter(self._status))]
            # Within the lock: accepted jobs come before the end of the queue.
            self._queue.put(functools.partial(self._execute, job, work))
        return job

    def check_free(self) -> None:
        """Raise CellStateError if `start` would refuse every job, e.g. while a job runs."""
        with self._changed:
            if self._refusing:
                raise CellStateError("the cell is closed; load the plugin again")
            running = [job for job, status in self._status.items() if not status.outcome.terminal]
            if running:
                raise CellStateError(
                    f"job {running[0].number} is not over; wait for its result or cancel it"
                )

    def status(self, job: Job) -> JobStatus:
        """Return the state of a job. Raises CellStateError for a job of another worker."""
        with self._changed:
            try:
                return self._status[job]
            except KeyError:
                raise CellStateError(f"there is no job {job.number} in this cell") from None

    def wait(self, job: Job, timeout_s: float | None) -> JobStatus:
        """Wait for the end of a job; None: without a limit.

        Raises TimeoutError if it does not end in time; it continues.
        """
        end_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while not (status := self.status(job)).outcome.terminal:
            if (left_s := end_s - time.monotonic()) <= 0.0:
                raise TimeoutError(f"job {job.number} is not over after {timeout_s:g} s")
            with self._changed:
                self._changed.wait_for(
                    lambda: self._status[job].outcome.terminal, min(left_s, SIGNAL_LOOK_S)
                )
        return status

    @property
    def running(self) -> bool:
        """Whether a job has not ended yet."""
        with self._changed:
            return any(not status.outcome.terminal for status in self._status.values())

    @property
    def working(self) -> bool:
        """Whether the thread makes progress in a job, or supervises the cell in time."""
        silent_s = time.monotonic() - max(self.looked_s, self._progressed_s())
        if self.running:
            return silent_s <= JOB_SILENT_S
        return self.idle_period_s is None or silent_s <= _SILENT_S

    def between_jobs(self, act: Callable[[], None]) -> None:
        """Call a function on the thread after the accepted jobs; it must not fail."""
        self._queue.put(act)

    def refuse(self) -> None:
        """Accept no further job; accepted jobs run to their end."""
        with self._changed:
            self._refusing = True

    def end(self, last: Callable[[], None] = lambda: None) -> None:
        """Accept no further job; after the accepted jobs the thread calls ``last`` and ends."""
        self.refuse()
        self._queue.put(last)
        self._queue.put(None)

    def close(self, timeout_s: float) -> None:
        """End the thread after the accepted jobs; further jobs are refused.

        Raises CellStateError if a job calls this itself, because it would wait for its own end.
        Raises TimeoutError if the end takes too long; the jobs continue.
        """
        self.check_outside()
        self.end()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise TimeoutError(f"the cell's thread has not ended after {timeout_s:g} s")

    def check_outside(self) -> None:
        """Raise CellStateError on the thread of the cell, which cannot wait for its own end."""
        if threading.current_thread() is self._thread:
            raise CellStateError(
                "a job itself, for example its mover, called close, which would wait for the job's "
                "own end; cancel the job here, and close from another thread"
            )

    def supervise(self) -> None:
        """Supervise the cell once while no job runs; the cell latches faults."""
        with suppress(Exception):
            self._idle()

    def _execute(self, job: Job, work: Callable[[Report], Any]) -> None:
        def report(progress: dict[str, Any]) -> None:
            self._set(job, JobStatus(outcome=JobOutcome.EXECUTING, progress=progress))

        report({})
        try:
            value = work(report)
        except CellStopped as stop:
            self._end(job, JobOutcome.CANCELED, error=str(stop), exception=stop)
        except BaseException as error:
            self._end(job, JobOutcome.ABORTED, error=error_text(error), exception=error)
        else:
            self._end(job, JobOutcome.SUCCEEDED, value=value)

    def _end(self, job: Job, outcome: JobOutcome, **end: Any) -> None:
        progress = self.status(job).progress
        self._set(job, JobStatus(outcome=outcome, progress=progress, **end))

    def _set(self, job: Job, status: JobStatus) -> None:
        with self._changed:
            self._status[job], self.looked_s = status, time.monotonic()
            self._changed.notify_all()


def _serve(
    worker: "weakref.ref[CellWorker]",
    work: "queue.SimpleQueue[Callable[[], None] | None]",
) -> None:
    """Carry out the queue until its end, or until the worker is gone."""
    idle_period_s = None
    while True:
        if (owner := worker()) is not None:
            idle_period_s, owner.looked_s = owner.idle_period_s, time.monotonic()
        del owner
        try:
            item = work.get(timeout=idle_period_s)
        except queue.Empty:
            owner = worker()
            if owner is None:
                return
            owner.supervise()
            del owner
            continue
        if item is None:
            return
        item()
        del item  # it refers to the worker, and to the cell
