"""The processor time of tests: its limit for one test, its budget for a run, and its list.

A pytest plugin, loaded by the root's conftest. It measures processor time, not wall time, so a busy
machine fails no test. A slower processor gets more: each limit is multiplied by the time of a
reference loop over its time on the processor for which the limits were set.
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
"""Processor time of `loop_s` on the processor for which the limits were set, in s."""
_OWN, _SHARED = "processor_s", "shared_fixtures_s"


def loop_s() -> float:
    """Return the processor time of a fixed loop, in s: the least of five."""
    times_s = []
    for _ in range(5):
        start_s = time.thread_time()
        sum(number * number % 7 for number in range(200_000))
        times_s.append(time.thread_time() - start_s)
    return min(times_s)


def slowness() -> float:
    """Return how much slower this processor is now than the reference; at least 1."""
    return max(1.0, loop_s() / REFERENCE_LOOP_S)


def _used_s() -> float:
    """Return the processor time of this process and of its children that have ended, in s."""
    return time.process_time() + sum(os.times()[2:4])


class ProcessorTime:
    """Measures each test, fails one above the limit, and compares the sum with the budget."""

    def __init__(self, budget_s: float | None, list_path: str | None) -> None:
        self._budget_s = budget_s
        self._list_path = list_path
        self._start_s = 0.0
        self._shared_s = 0.0
        self._shared_depth = 0
        self._tests: dict[str, dict[str, float]] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self) -> Generator[None, object, object]:
        """Begin to measure a test."""
        self._start_s, self._shared_s = _used_s(), 0.0
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef[object]
    ) -> Generator[None, object, object]:
        """Measure fixtures that further tests share apart: they are no cost of this test."""
        if fixturedef.scope == "function" or self._shared_depth:
            return (yield)
        self._shared_depth += 1
        start_s = _used_s()
        try:
            return (yield)
        finally:
            self._shared_depth -= 1
            self._shared_s += _used_s() - start_s

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """Fail a test that has passed and took too long."""
        result = yield
        own_s = _used_s() - self._start_s - self._shared_s
        if (
            self._budget_s
            and own_s > TEST_LIMIT_S
            and not any(item.get_closest_marker(name) for name in EXEMPT)
        ):
            limit_s = TEST_LIMIT_S * slowness()
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
            own_s = _used_s() - self._start_s - self._shared_s
            item.user_properties += [(_OWN, own_s), (_SHARED, self._shared_s)]

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Collect the times, also from workers of xdist."""
        if report.when == "teardown":
            times_s = {name: value for name, value in report.user_properties if name in _NAMES}
            self._tests[report.nodeid] = times_s

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Write the list; fail a run above its budget."""
        if hasattr(session.config, "workerinput"):
            return
        if self._list_path is not None:
            lines = [f"{sum(one.values()):.3f} {name}" for name, one in self._tests.items()]
            Path(self._list_path).write_text("\n".join(lines) + "\n", encoding="utf-8")
        if self._budget_s is not None and self._total_s() > self._budget_s * slowness():
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Print the sum, with the budget where there is one."""
        total_s = self._total_s()
        text = f"{total_s:.0f} s of processor in {len(self._tests)} tests"
        if self._budget_s is not None:
            limit_s = self._budget_s * slowness()
            text += f", {'ABOVE ' if total_s > limit_s else ''}the budget of {limit_s:.0f} s"
        terminalreporter.write_line(text)

    def _total_s(self) -> float:
        return sum(sum(one.values()) for one in self._tests.values())


_NAMES = (_OWN, _SHARED)


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options for the budget and for the list."""
    parser.addoption(
        "--processor-budget", type=float, metavar="S", help="fail a run that takes more in all"
    )
    parser.addoption(
        "--processor-times", metavar="FILE", help="write the processor time of each test"
    )


def pytest_configure(config: pytest.Config) -> None:
    """Load the plugin, in each worker too."""
    config.pluginmanager.register(
        ProcessorTime(
            config.getoption("--processor-budget"), config.getoption("--processor-times")
        ),
        "processor_time",
    )
