"""Processes that the tests across processes share: a relay that spoils bytes, and its priority."""

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

_RELAY = Path(__file__).parent / "servo_relay.py"
_SEED = "7"


def _first(pid: int) -> None:
    """Let a process go before others, where permitted: real hardware waits for nobody."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(pid, os.SCHED_FIFO, os.sched_param(40))


class Relay:
    """The process of `servo_relay.py` between a program and the terminal of a device."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.port = self._said()

    def _said(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline().strip()

    def order(self, text: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(text + "\n")
        if text == "hang_up":
            self._process.wait(5.0)
        else:
            assert self._said() == "yes"


@contextlib.contextmanager
def _relay_on(port: str) -> Iterator[Relay]:
    process = subprocess.Popen(
        [sys.executable, str(_RELAY), port, _SEED],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        bufsize=1,
    )
    try:
        _first(process.pid)
        yield Relay(process)
    finally:
        process.kill()
        process.communicate()


@pytest.fixture(scope="session")
def first() -> Callable[[int], None]:
    """Return what lets a process go before others."""
    return _first


@pytest.fixture(scope="session")
def relay_on() -> Callable[[str], AbstractContextManager[Relay]]:
    """Return what puts a relay on a terminal; the relay has a terminal of its own, `port`."""
    return _relay_on
