"""What the process of the force loop asks of the system, granted and refused."""

import errno
import gc
import os
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from cell.config.model import LoopConfig
from cell.control.journal import loop_line, loop_values
from cell.hand import real_time
from gripper.force.timing import Distribution, LoopStatistics


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Any]]:
    """Catch what would change this process, and undo the size of new threads' stacks."""
    calls: list[Any] = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *a: calls.append(a[1:]))
    monkeypatch.setattr(os, "sched_setaffinity", lambda *a: calls.append(a[1]))
    monkeypatch.setattr(real_time, "lock_memory", lambda: calls.append("lock"))
    before = threading.stack_size()
    yield calls
    threading.stack_size(before)


def refuse(*_args: Any) -> None:
    raise PermissionError(errno.EPERM, "Operation not permitted")


def test_what_is_configured_is_asked_for_and_nothing_else(asked) -> None:
    assert real_time.enter_real_time(LoopConfig(priority=0, lock_memory=False)) == ()
    assert asked == []
    assert real_time.enter_real_time(LoopConfig(cpu=0, priority=42)) == ()
    assert asked == [{0}, "lock", (os.SCHED_FIFO, os.sched_param(42))]


@pytest.mark.usefixtures("asked")
def test_what_is_refused_is_noted_with_its_meaning_and_remedy(monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(os, "sched_setaffinity", refuse)
    monkeypatch.setattr(real_time, "lock_memory", refuse)
    notes = real_time.enter_real_time(LoopConfig(cpu=1000))
    assert len(notes) == 3
    assert "was not bound to processor 1000 (Operation not permitted): correct loop.cpu" in notes[0]
    assert "paging may delay it" in notes[1]
    assert "without real-time priority" in notes[2]
    assert "ulimit -r" in notes[2]


def test_memory_that_may_not_be_locked_is_an_error(monkeypatch) -> None:
    class Libc:
        @staticmethod
        def mlockall(flags: int) -> int:
            assert flags == 3
            real_time.ctypes.set_errno(errno.ENOMEM)
            return -1

    monkeypatch.setattr(real_time.ctypes, "CDLL", lambda *_args, **_options: Libc)
    with pytest.raises(OSError, match="Cannot allocate memory"):
        real_time.lock_memory()


def test_garbage_is_collected_between_jobs_only() -> None:
    try:
        real_time.stop_collecting()
        assert not gc.isenabled()
    finally:
        gc.enable()
        gc.unfreeze()


def test_one_line_says_whether_the_loop_was_on_time() -> None:
    statistics = LoopStatistics(
        cycles=12_345,
        overruns=3,
        late=2,
        missed_reads=1,
        worst_lateness_s=1.25e-3,
        lateness=Distribution(n=9, p50_s=6e-5, p99_s=2e-4, p999_s=9e-4, max_s=1.25e-3),
        transaction=Distribution(n=9, p50_s=1.1e-3, p99_s=2e-3),
        sensor_age=Distribution(n=9, max_s=0.031),
    )
    assert loop_line(statistics, 0.005) == (
        "Force loop: of 12,345 periods of 5 ms 5 were late, by up to 1.2 ms, 1 without an answer "
        "of the servos."
    )
    assert loop_line(LoopStatistics(cycles=9), 0.005) == "Force loop: on time."
    assert loop_line(LoopStatistics(), 0.005) == "Force loop: not started."
    values = loop_values(statistics, undelivered=2)
    assert (values["lateness_p999_s"], values["undelivered"]) == (9e-4, 2)


@pytest.mark.parametrize(("priority", "granted"), [(0, True), (49, True), (49, False)])
def test_a_simulated_device_gets_priority_where_granted_and_gives_it_back(
    monkeypatch, priority, granted
) -> None:
    calls: list[Any] = []
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    monkeypatch.setattr(
        os, "sched_setscheduler", lambda *a: calls.append(a[1:]) if granted else refuse()
    )
    with real_time.raised_priority(priority):
        calls.append("served")
    fifo = (os.SCHED_FIFO, os.sched_param(49))
    assert calls == ([fifo, "served", before] if granted and priority else ["served"])
