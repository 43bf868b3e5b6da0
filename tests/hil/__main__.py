"""Run the tests in real time, and say in the open which of them needed a second attempt.

    python -m tests.hil [PYTEST_OPTION ...]

A test that judges times can fail where another program takes the processors for a moment. So what
fails is run once more, and the last lines name it with the load of the machine. What needs a second
attempt on a quiet machine is a defect: of the test, or of the product.
"""

import os
import sys
from collections.abc import Sequence

import pytest

ATTEMPTS = 2


class Failed:
    """Plugin of pytest that collects the tests that fail."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and report.nodeid not in self.names:
            self.names.append(report.nodeid)


def main(options: Sequence[str]) -> int:
    """Run the tests and return pytest's exit code of the last attempt."""
    names: list[str] = []
    said: list[str] = []
    code = 0
    for attempt in range(1, ATTEMPTS + 1):
        load, failed = os.getloadavg()[0], Failed()
        code = int(pytest.main(["-m", "real_time", *options, *names], plugins=[failed]))
        said += [f"attempt {attempt}, load {load:.1f}: {name} failed" for name in failed.names]
        if code != pytest.ExitCode.TESTS_FAILED:
            break
        names = failed.names
    quiet = os.getloadavg()[0] <= (os.cpu_count() or 1)
    print(
        f"{'quiet' if quiet else 'NOT a quiet'} machine; {len(said)} attempts failed",
        *said,
        sep="\n",
    )
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
