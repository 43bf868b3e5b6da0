"""The package's own plugin, loaded after pytest-cov has started, and the slice of long tests.

Users get it as an entry point, which pytest imports before; `addopts` in pyproject.toml blocks that
here. A run that overrides `addopts` has it already.

What runs in real time asks for `free_machine`.
"""

import datetime
import os
import sys
import time
import zlib
from collections.abc import Generator, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

# Threads of the linear algebra only spin where tests share the processors.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Contracts that a user runs in a checkout need none of the packages for its own tests.
with suppress(ImportError):
    from hypothesis import settings

    settings.register_profile("tests", derandomize=True, deadline=None)
    settings.load_profile("tests")

_NAME = "pytest_tactile_cell"
if _NAME not in sys.modules:  # else a user's folder runs the contracts of this checkout
    pytest_plugins = ["pytester", "tests.processor_time", _NAME]

_LOAD_BEFORE = os.getloadavg()[0]
"""Load of the machine before these tests."""
_LOAD_MARGIN = 0.5
_WAITED_SHARE = 0.5
"""Share of the time of a test in which processes waited for a processor; more is no fair test."""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the contract tests of drives and of the slice of a day."""
    parser.addoption(
        "--days",
        type=int,
        metavar="N",
        help="run the slice of today alone: all tests have run after N days",
    )
    parser.addoption(
        "--axes",
        action="store_true",
        help="tests/contract: the real drives of the positioner in --cell-config, too",
    )


@pytest.fixture
def undo() -> Iterator[ExitStack]:
    """Return the stack of what a test opens; it is closed at the end, the last one first."""
    with ExitStack() as stack:
        yield stack


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect what other days run."""
    n_days = config.getoption("--days", None)
    if not n_days:
        return
    today = datetime.datetime.now(datetime.UTC).toordinal() % n_days
    rest = {item for item in items if zlib.crc32(item.nodeid.encode()) % n_days != today}
    items[:] = [item for item in items if item not in rest]
    config.hook.pytest_deselected(items=list(rest))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None]:
    """Skip a test in real time that fails while other programs use up the processors."""
    return (yield from _judged(item))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None]:
    """Skip a test in real time that fails while other programs use up the processors."""
    return (yield from _judged(item))


def _judged(item: pytest.Item) -> Generator[None]:
    if item.get_closest_marker("real_time") is None:
        return (yield)
    began_s, before_s = time.monotonic(), _waited_s()
    try:
        return (yield)
    except (Exception, pytest.fail.Exception) as error:
        share = (_waited_s() - before_s) / (time.monotonic() - began_s)
        if share <= _WAITED_SHARE:
            raise
        raise pytest.skip.Exception(
            f"processes waited for a processor in {share:.0%} of its time: {error!r:.300}"
        ) from error


def _waited_s() -> float:
    """Return the time in s in which some process waited for a processor (Linux, PSI); else 0."""
    with suppress(OSError):
        return 1e-6 * float(
            Path("/proc/pressure/cpu").read_text().partition("total=")[2].split()[0]
        )
    return 0.0


@pytest.fixture(scope="session")
def free_machine() -> None:
    """Skip where other programs use up the processors: then no real time can be judged.

    TACTILE_CELL_ANY_LOAD=1 runs them at any load.
    """
    load, processors = _LOAD_BEFORE, os.cpu_count() or 1
    if load > processors + _LOAD_MARGIN and "TACTILE_CELL_ANY_LOAD" not in os.environ:
        pytest.skip(
            f"load {load:.1f} on {processors} processors leaves no real time to test in; "
            "TACTILE_CELL_ANY_LOAD=1 tests all the same"
        )
