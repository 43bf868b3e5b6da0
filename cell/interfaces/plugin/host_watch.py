"""The host watch: notices that the host program has fallen silent while a job runs."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass

from gripper.clock import Clock

_LOOKS = 10
"""Checks within one time-out: a silence is noticed at most a tenth of it late."""


@dataclass
class HostWatch:
    """Calls back once when no call of the host has come for too long while a job runs.

    A host that waits within a call is there. The watch has a thread of its own, because the thread
    of the cell is busy with the job.
    """

    timeout_s: float
    """Longest silence in s."""
    _: KW_ONLY
    running: Callable[[], bool]
    silent: Callable[[float], None]
    """Whether a job runs; called with the silence in s, once for each silence."""
    clock: Clock = time
    """Time of the host: real time also where that of the cell is virtual."""

    def __post_init__(self) -> None:
        self._lock = threading.Lock()
        self._inside, self._reported = 0, False
        self._heard_s = self.clock.monotonic()
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
                self._heard_s = self.clock.monotonic()
                self._reported = False

    def look(self) -> None:
        """Call back if the silence is too long now."""
        with self._lock:
            silent_s = self.clock.monotonic() - self._heard_s
            if self._inside or self._reported or silent_s <= self.timeout_s or not self.running():
                return
            self._reported = True
        self.silent(silent_s)

    def end(self) -> None:
        """Let the thread end, without waiting for it."""
        self._over.set()

    def close(self) -> None:
        """End the thread."""
        self.end()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(self.timeout_s / _LOOKS):
            self.look()
