"""The worker of a cell: its thread owns the cell, runs its jobs, and supervises it between jobs."""

import functools
import math
import queue
import threading
import time
import uuid
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, computed_field

from cell.control.part import Part, Verification
from cell.errors import CellError, CellStateError, CellStopped, RequestRefused
from cell.fault_catalogue import error_text, fault_number

MOST_JOBS = 100
"""Newest jobs that are kept, so that the memory of a resident program stays bounded."""
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
        return self.number >= _NUMBERS["SUCCEEDED"]

    @property
    def number(self) -> int:
        """Its number for hosts: GoalStatus of ROS 2 actions."""
        return _NUMBERS[self.value]


_NUMBERS = {"ACCEPTED": 1, "EXECUTING": 2, "SUCCEEDED": 4, "CANCELED": 5, "ABORTED": 6}


class Job(BaseModel):
    """A job at one moment, as all programs read it."""

    model_config = ConfigDict(
        frozen=True, use_attribute_docstrings=True, arbitrary_types_allowed=True
    )

    number: int = 0
    """Its number among the jobs of its cell, from 1; 0: there is no job yet."""
    task: str = ""
    """Its task or command."""
    since_s: float = 0.0
    """Unix time in s of its start."""
    outcome: JobOutcome | None = None
    """Its state; None: there is no job yet."""
    part: Part | None = None
    """Part of an identification, before its end the name so far without an id; newest part of a
    sort."""
    verification: Verification | None = None
    """Answer of a grip or a verify."""
    progress: Mapping[str, Any] = Field(default_factory=dict)
    """Its last report; the keys depend on the task."""
    error: str = ""
    """Why it failed, as text; else empty."""
    value: Any = Field(default=None, exclude=True, repr=False)
    """Its result after success."""
    exception: BaseException | None = Field(default=None, exclude=True, repr=False)
    """The error that ended it; None without an error."""
    worker: str = Field(default="", exclude=True, repr=False)
    """Name of its worker: jobs of two cells have the same numbers."""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def outcome_number(self) -> int:
        """Number of its state for hosts; 0: there is no job yet."""
        return 0 if self.outcome is None else self.outcome.number

    @computed_field  # type: ignore[prop-decorator]
    @property
    def fault_number(self) -> int:
        """Number of the error in the fault catalogue; 0 without an error."""
        return fault_number(self.exception)

    @property
    def terminal(self) -> bool:
        """Whether it is over."""
        return self.outcome is not None and self.outcome.terminal


class JobFailed(CellError):
    """A job was cancelled or aborted; ``__cause__`` is the error that ended it."""

    def __init__(self, job: Job) -> None:
        assert job.outcome is not None
        super().__init__(f"job {job.number} {job.outcome.value}: {job.error}")
        self.job = job
        self.outcome = job.outcome
        """``CANCELED`` or ``ABORTED``."""
        self.fault_number = job.fault_number
        """Number of the error that ended the job, in the fault catalogue."""


@dataclass(frozen=True, slots=True)
class Report:
    """Reports the progress of one job, in the thread of the cell."""

    number: int
    """Number of the job."""
    change: Callable[..., object]
    """Replaces fields of the job."""

    def __call__(self, progress: dict[str, Any], **fields: Any) -> None:
        """Report progress, and further fields of the `Job`, for example its part."""
        self.change(progress=progress, **fields)


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
        self._changed = threading.Condition()  # of a reentrant lock
        self._jobs: dict[int, Job] = {}
        self._newest = self._named = 0
        self._thread = threading.Thread(
            target=_serve, args=(weakref.ref(self), self._queue), name="tactile-cell", daemon=True
        )
        self._thread.start()

    def start(
        self,
        task: str,
        work: Callable[[Report], Any],
        *,
        accepted: Callable[[], None] = lambda: None,
        on_change: Callable[[Job], None] = lambda _job: None,
    ) -> Job:
        """Accept a job; return at once.

        ``work`` gets what reports its progress, and returns the result. ``accepted`` is called
        before it runs and after other jobs have ended; an error that it raises refuses the job.
        ``on_change`` is called on the thread with the job after each report. Raises CellStateError
        if another job has not ended, or the cell is being closed.
        """
        with self._changed:
            self.check_free()
            accepted()
            job = Job(
                number=self._newest + 1,
                task=task,
                since_s=time.time(),
                outcome=JobOutcome.ACCEPTED,
                worker=self._name,
            )
            self._newest, self.looked_s = job.number, time.monotonic()
            self._jobs[job.number] = job
            if len(self._jobs) > MOST_JOBS:
                del self._jobs[next(number for number in self._jobs if number != self._named)]
            # Within the lock: accepted jobs come before the end of the queue.
            self._queue.put(functools.partial(self._execute, job.number, work, on_change))
        return job

    def check_free(self) -> None:
        """Raise CellStateError if `start` would refuse every job, e.g. while a job runs."""
        with self._changed:
            if self._refusing:
                raise CellStateError("the cell is closed; load the plugin again")
            if self.running:
                raise CellStateError(
                    f"job {self._newest} is not over; wait for its result or cancel it"
                )

    def jobs(self) -> tuple[Job, ...]:
        """Return the newest jobs, at most `MOST_JOBS`, oldest first."""
        with self._changed:
            return tuple(self._jobs.values())

    def job(self, number: int | None = None) -> Job:
        """Return a job, the newest by default. Raises RequestRefused for an unknown number.

        The newest job with a named part stays among the kept jobs.
        """
        with self._changed:
            if number is None:
                return self._jobs.get(self._newest, Job())
            if number not in self._jobs:
                raise RequestRefused(f"job {number} is not kept; the newest is {self._newest}")
            return self._jobs[number]

    def status(self, job: Job) -> Job:
        """Return a job as it is now. Raises CellStateError for a job of another worker."""
        if job.worker != self._name:
            raise CellStateError(f"there is no job {job.number} in this cell")
        return self.job(job.number)

    def wait(self, job: Job, timeout_s: float | None) -> Job:
        """Wait for the end of a job; None: without a limit.

        Raises TimeoutError if it does not end in time; it continues.
        """
        end_s = math.inf if timeout_s is None else time.monotonic() + timeout_s
        while not (now := self.status(job)).terminal:
            if (left_s := end_s - time.monotonic()) <= 0.0:
                raise TimeoutError(
                    f"job {job.number} is not over after {timeout_s:g} s: it continues"
                )
            with self._changed:
                self._changed.wait_for(
                    lambda: self._jobs[job.number].terminal, min(left_s, SIGNAL_LOOK_S)
                )
        return now

    @property
    def running(self) -> bool:
        """Whether a job has not ended yet."""
        job = self.job()
        return job.number > 0 and not job.terminal

    @property
    def working(self) -> bool:
        """Whether the thread makes progress in a job, or supervises the cell in time."""
        silent_s = time.monotonic() - max(self.looked_s, self._progressed_s())
        if self.running:
            return silent_s <= JOB_SILENT_S
        return self.idle_period_s is None or silent_s <= _SILENT_S

    def between_jobs(self, act: Callable[[], None]) -> None:
        """Call a function on the thread after the accepted jobs; it must not fail.

        A callback of a job is on that thread, and would wait for itself: the call is then at once.
        """
        if threading.current_thread() is self._thread:
            act()
        else:
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

    def _execute(
        self, number: int, work: Callable[[Report], Any], on_change: Callable[[Job], None]
    ) -> None:
        def change(**fields: Any) -> None:
            on_change(self._set(number, **fields))

        self._set(number, outcome=JobOutcome.EXECUTING)
        try:
            value = work(Report(number, change))
        except CellStopped as stop:
            end = {"outcome": JobOutcome.CANCELED, "error": str(stop), "exception": stop}
        except BaseException as error:
            end = {"outcome": JobOutcome.ABORTED, "error": error_text(error), "exception": error}
        else:
            end = {"outcome": JobOutcome.SUCCEEDED, "value": value}
            if isinstance(value, Part):
                end["part"], self._named = value, number
            elif isinstance(value, Verification):
                end["verification"] = value
        self._set(number, **end)

    def _set(self, number: int, **fields: Any) -> Job:
        with self._changed:
            job = self._jobs[number] = self._jobs[number].model_copy(update=fields)
            self.looked_s = time.monotonic()
            self._changed.notify_all()
        return job


def _serve(
    worker: "weakref.ref[CellWorker]", work: "queue.SimpleQueue[Callable[[], None] | None]"
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
