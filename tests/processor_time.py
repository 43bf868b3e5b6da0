"""The processor time of tests: its limit for one test, and its list.

A pytest plugin, loaded by the root's conftest. It measures processor time, not wall time, so a busy
machine fails no test. A slower processor gets more: the limit is multiplied by the time of a
reference loop over its time on the processor for which the limit was set.
"""

import os
import time
from collections.abc import Generator
from pathlib import Path

import pytest

TEST_LIMIT_S = 1.0
"""Longest processor time of a test without one of `EXEMPT`, in s of the reference processor."""
EXEMPT = ("slow", "long", "real_time")
"""Markers of tests that may take longer."""
REFERENCE_LOOP_S = 0.010
"""Processor time of `loop_s` on the processor for which the limit was set, in s."""
USUAL_LOAD = 1.5
"""Load of each processor by the tests alone: a worker on each, and the processes that it starts."""
_TOOK = "processor_s"


def loop_s() -> float:
    """Return the processor time of a fixed loop, in s: the least of five."""
    times_s = []
    for _ in range(5):
        start_s = time.thread_time()
        sum(number * number % 7 for number in range(200_000))
        times_s.append(time.thread_time() - start_s)
    return min(times_s)


def slowness(reference_s: float) -> float:
    """Return how much slower this processor is than the reference; at least 1.

    Programs that wait for a processor push each other out of its caches. The short loop does not
    show this, so it counts by the load of the last minutes, up to a factor of 2.
    """
    waiting = max(os.getloadavg()[:2]) / (os.cpu_count() or 1)
    return min(2.0, max(1.0, waiting / USUAL_LOAD)) * max(1.0, reference_s / REFERENCE_LOOP_S)


def _used_s() -> float:
    """Return the processor time of this process and of its children that have ended, in s."""
    return time.process_time() + sum(os.times()[2:4])


class ProcessorTime:
    """Measures each test, and fails one above the limit."""

    def __init__(self, list_path: str | None) -> None:
        self._list_path = list_path
        self._start_s = 0.0
        self._tests: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Generator[None, object, object]:
        """Begin to measure a test."""
        self._start_s = _used_s()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """Fail a test that has passed and took too long; its fixtures do not count."""
        start_s = _used_s()
        result = yield
        own_s = _used_s() - start_s
        if own_s > TEST_LIMIT_S and not any(item.get_closest_marker(name) for name in EXEMPT):
            limit_s = TEST_LIMIT_S * slowness(loop_s())
            if own_s > limit_s:
                pytest.fail(
                    f"it took {own_s:.2f} s of processor, the limit is {limit_s:.2f} s; simulate "
                    "less, or mark it `slow`",
                    pytrace=False,
                )
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Generator[None, object, object]:
        """Add the times to the report."""
        try:
            return (yield)
        finally:
            item.user_properties.append((_TOOK, _used_s() - self._start_s))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Collect the times, also from workers of xdist."""
        if report.when == "teardown":
            self._tests[report.nodeid] = float(dict(report.user_properties)[_TOOK])

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the list."""
        if self._list_path is not None and not hasattr(session.config, "workerinput"):
            lines = [f"{took_s:.3f} {name}" for name, took_s in self._tests.items()]
            Path(self._list_path).write_text("\n".join(lines) + "\n", encoding="utf-8")

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the sum."""
        total_s = sum(self._tests.values())
        terminalreporter.write_line(f"{total_s:.0f} s of processor in {len(self._tests)} tests")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the list."""
    parser.addoption("--processor-times", metavar="FILE", help="write the time of each test")


def pytest_configure(config: pytest.Config) -> None:
    """Load the plugin, in each worker too."""
    plugin = ProcessorTime(config.getoption("--processor-times"))
    config.pluginmanager.register(plugin, "processor_time")
