"""The host watch: notices that the host program has fallen silent while a job runs."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from gripper.clock import Clock

_LOOKS = 10
"""Checks within one time-out: a silence is noticed at most a tenth of it late."""


class HostWatch:
    """Calls back once when no call of the host has come for too long while a job runs.

    A host that waits within a call is there. The watch has a thread of its own, because the thread
    of the cell is busy with the job.

    Parameters
    ----------
    timeout_s
        Longest silence in s.
    silent
        Called with the silence in s, once for each silence.
    clock
        Time of the host: real time also where that of the cell is virtual.
    """

    def __init__(
        self,
        timeout_s: float,
        *,
        running: Callable[[], bool],
        silent: Callable[[float], None],
        clock: Clock = time,
    ) -> None:
        self._timeout_s = timeout_s
        self._running = running
        self._silent = silent
        self._clock = clock
        self._lock = threading.Lock()
        self._inside = 0
        self._heard_s = clock.monotonic()
        self._reported = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="host-watch", daemon=True)
        self._thread.start()

    @contextmanager
    def calling(self) -> Iterator[None]:
        """Take note of a call of the host, for as long as it lasts."""
        with self._lock:
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                self._heard_s = self._clock.monotonic()
                self._reported = False

    def look(self) -> None:
        """Call back if the silence is too long now."""
        with self._lock:
            silent_s = self._clock.monotonic() - self._heard_s
            if self._inside or self._reported or silent_s <= self._timeout_s or not self._running():
                return
            self._reported = True
        self._silent(silent_s)

    def end(self) -> None:
        """Let the thread end, without waiting for it."""
        self._over.set()

    def close(self) -> None:
        """End the thread."""
        self.end()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(self._timeout_s / _LOOKS):
            self.look()
