"""Waits of tests for threads and processes, with a limit."""

import threading
import time
from collections.abc import Callable
from typing import Any

LIMIT_S = 60.0
"""Patience of the tests: a condition that is not met by then fails."""


def until(true: Callable[[], Any]) -> Any:
    """Wait for a condition and return it."""
    end_s = time.monotonic() + LIMIT_S
    while not (result := true()):
        assert time.monotonic() < end_s
        threading.Event().wait(0.005)
    return result
