"""Signals and the death of the parent: the first stops a sequence, the second ends the program."""

import faulthandler
import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_LOOK_S = 0.1
"""Time in s between two checks that the parent process exists."""

INTERRUPTED = "interrupted"
NOTHING_LET_GO = (
    "; nothing was let go: `tactile-cell hand release --config FILE --confirm` opens the grip of a "
    "real cell"
)
"""End of the message if a cell may hold a part and no command can let it go."""
END_WITHIN_S = 0.4
"""Time in s for closing files after a second signal; then the program ends."""


@contextmanager
def stopping(cancel: Callable[[], None], *, left: str = "") -> Iterator[None]:
    """Within the block the first signal calls ``cancel``; a second raises KeyboardInterrupt.

    The second signal prints an error at once, followed by ``left``. After `END_WITHIN_S` the
    program ends with exit code 1; further signals have no effect. The recording can be recovered,
    and the grip is kept.

    The end of the parent process counts as a signal. A program that was started with SIGHUP
    ignored (``nohup``) keeps running without terminal and parent.
    """
    seen = 0

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        nonlocal seen
        seen += 1
        cancel()  # the second signal may interrupt the first before this call
        if seen > 1:
            for number in watched:
                signal.signal(number, signal.SIG_IGN)
            _end_after(END_WITHIN_S)
            with suppress(OSError):
                os.write(2, f"\nerror: {INTERRUPTED}{left}\n".encode())
            raise KeyboardInterrupt

    outlives = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    watched = [number for number in _SIGNALS if not (outlives and number is signal.SIGHUP)]
    before = {number: signal.signal(number, on_signal) for number in watched}
    over = threading.Event()
    if not outlives:
        threading.Thread(
            target=_watch_parent, args=(cancel, over), name="parent", daemon=True
        ).start()
    try:
        yield
    finally:
        over.set()
        # A third signal must not delay a program that is about to end.
        if seen < 2:
            for number, handler in before.items():
                signal.signal(number, handler)


@contextmanager
def as_interrupts() -> Iterator[None]:
    """Within the block the first signal raises KeyboardInterrupt; further signals are ignored.

    So they cannot interrupt the clean-up, which switches off the torque of moving servos.
    """

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        for number in before:
            signal.signal(number, signal.SIG_IGN)
        raise KeyboardInterrupt

    before = {number: signal.getsignal(number) for number in _SIGNALS}
    for number in before:
        signal.signal(number, on_signal)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end_after(timeout_s: float) -> None:
    """End this program with exit code 1 after a time, even if it hangs outside the interpreter.

    The timer of `faulthandler` needs no interpreter, and its exit code is 1. Its stack traces are
    discarded.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY | os.O_CLOEXEC)  # stays open until the end
    faulthandler.dump_traceback_later(timeout_s, exit=True, file=nowhere)


def _watch_parent(cancel: Callable[[], None], over: threading.Event) -> None:
    """Call ``cancel`` once when another process has become the parent of this one."""
    parent = os.getppid()
    while not over.wait(_LOOK_S):
        if os.getppid() != parent:
            cancel()
            return
