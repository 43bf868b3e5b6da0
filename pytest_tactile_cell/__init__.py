"""pytest plugin for tests of cells: simulated cells, real buses, faults.

pytest finds it by the entry point ``tactile-cell`` of the group ``pytest11``. Other test runs stay
fast: tactile-cell and its libraries are imported when a test requests a fixture. Start at
`pytest_tactile_cell.fixtures`; docs/how-to/test-your-cell.md shows how to use it.
"""

from pytest_tactile_cell.fixtures import (
    can_bus,
    can_clock,
    cell_bench,
    cell_config,
    cell_faults,
    cell_process,
    cell_runtime,
    inject_fault,
    servo_bus,
    servo_clock,
    servo_stream,
    simulated_cell,
)
from pytest_tactile_cell.options import (
    pytest_addoption,
    pytest_configure,
    pytest_generate_tests,
    pytest_report_header,
)

__all__ = [
    "can_bus",
    "can_clock",
    "cell_bench",
    "cell_config",
    "cell_faults",
    "cell_process",
    "cell_runtime",
    "inject_fault",
    "pytest_addoption",
    "pytest_configure",
    "pytest_generate_tests",
    "pytest_report_header",
    "servo_bus",
    "servo_clock",
    "servo_stream",
    "simulated_cell",
]
