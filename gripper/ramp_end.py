"""The request to end a ramp where it is, from whichever thread."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class RampEnd:
    """Counts a request only during a grasp: one that comes too late is not kept for the next."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running = False
        self._requested = False

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Take requests from the beginning of a grasp to its end."""
        with self._lock:
            self._running, self._requested = True, False
        try:
            yield
        finally:
            with self._lock:
                self._running = self._requested = False

    def request(self) -> None:
        """Ask for the end of the ramp of the grasp that runs; does nothing where none does."""
        with self._lock:
            self._requested = self._running

    @property
    def requested(self) -> bool:
        """Whether the ramp of the grasp that runs is to end."""
        return self._requested
