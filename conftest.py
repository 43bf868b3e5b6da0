"""The package's own plugin, loaded after pytest-cov has started.

Users get it as an entry point, which pytest imports before; `addopts` in pyproject.toml blocks that
here. A run that overrides `addopts` has it already.

What runs in real time asks for `free_machine`.
"""

import os
import sys

import pytest

_NAME = "cell.pytest_plugin"
pytest_plugins = ["pytester", *([] if _NAME in sys.modules else [_NAME])]

_LOAD_BEFORE = os.getloadavg()[0]
"""Load of the machine before these tests."""
_LOAD_MARGIN = 0.5


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option of the contract tests of drives."""
    parser.addoption(
        "--axes",
        action="store_true",
        help="tests/contract: the real drives of the positioner in --cell-config, too",
    )


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
