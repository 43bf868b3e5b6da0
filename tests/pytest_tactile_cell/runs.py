"""Runs of pytest within a test, with the plugin that is tested."""

import pytest

# In-process runs of pytester forget what they import; numpy does not bear being imported twice.
import pytest_tactile_cell.bench
import pytest_tactile_cell.process
import pytest_tactile_cell.virtual  # noqa: F401


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    # Each run would import hypothesis anew, which takes longer than the run.
    quick = ("-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:hypothesispytest")
    return pytester.runpytest_inprocess(*quick, *arguments)
