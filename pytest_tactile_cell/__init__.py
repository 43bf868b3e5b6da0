"""pytest plugin for tests of cells: simulated cells, real buses, faults.

pytest finds it by the entry point ``tactile-cell`` of the group ``pytest11``. Other test runs stay
fast: tactile-cell and its libraries are imported when a test requests a fixture. Start at
`pytest_tactile_cell.fixtures`; docs/how-to/test-your-cell.md shows how to use it.
"""

pytest_plugins = ("pytest_tactile_cell.options", "pytest_tactile_cell.fixtures")
"""Modules with the options and the fixtures, which pytest loads with this one."""
