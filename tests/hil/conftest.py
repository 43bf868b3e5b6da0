"""What the tests across processes share: a relay that damages bytes, and its priority."""

from collections.abc import Callable
from contextlib import AbstractContextManager

import pytest

from tests.hil import damage


@pytest.fixture(scope="session")
def first() -> Callable[[int], None]:
    """Return what lets a process go before others."""
    return damage.first


@pytest.fixture(scope="session")
def relay_on() -> Callable[[str, str], AbstractContextManager[damage.Relay]]:
    """Return what puts a relay on a line, ``servos`` or ``can``; its own terminal is `port`."""
    return damage.relay_on
