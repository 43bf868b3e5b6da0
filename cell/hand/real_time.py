"""Real-time settings of a process: priority, locked memory, processor, garbage collection."""

import ctypes
import gc
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from cell.config.model import LoopConfig

_MCL_CURRENT = 1
_MCL_FUTURE = 2
"""Flags of mlockall(2): present pages and future pages."""
_STACK_BYTES = 512 << 10
"""Stack of each thread in bytes: all of it is locked; the default 8 MB exceeds most limits."""


def enter_real_time(config: LoopConfig) -> tuple[str, ...]:
    """Ask for scheduling, memory and processor as in the config; return what was refused.

    Call it before threads are started: they inherit the scheduling, so that no thread holds
    the interpreter's lock while it waits for a processor. Each note names the consequence and
    the remedy.
    """
    threading.stack_size(_STACK_BYTES)
    settings: tuple[tuple[bool, Callable[[], None], str], ...] = (
        (
            config.cpu is not None,
            lambda: os.sched_setaffinity(0, {config.cpu or 0}),
            f"the force loop was not bound to processor {config.cpu} ({{}}): correct loop.cpu",
        ),
        (
            config.lock_memory,
            lock_memory,
            "the memory of the force loop is not locked, paging may delay it ({}): raise "
            "`ulimit -l` (limits.conf: memlock)",
        ),
        (
            config.priority > 0,
            lambda: os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(config.priority)),
            "the force loop runs without real-time priority, other programs may delay it ({}): "
            "raise `ulimit -r` (limits.conf: rtprio)",
        ),
    )
    notes = []
    for wanted, ask, refused in settings:
        try:
            if wanted:
                ask()
        except OSError as error:
            notes.append(refused.format(error.strerror))
    return tuple(notes)


def lock_memory() -> None:
    """Lock all present and future pages of this process. Raises OSError if refused."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


@contextmanager
def raised_priority(priority: int) -> Iterator[None]:
    """Run the block with a real-time priority if the system grants it; 0: no priority.

    For a simulated device: a real one does not wait for a processor. A refusal raises nothing; the
    device then sometimes answers late.
    """
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    granted = False
    if priority > 0:
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            granted = True
    try:
        yield
    finally:
        if granted:
            os.sched_setscheduler(0, *before)


def stop_collecting() -> None:
    """Switch automatic garbage collection off; the server collects when nothing waits."""
    gc.collect()
    gc.freeze()
    gc.disable()
