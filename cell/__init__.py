"""The robot cell: puts gripper, tactile sensor, recogniser and positioner together.

The composition root and the only package that imports all others. Start at `cell.build.build_cell`
(a cell from a config), `cell.control.controller.CellController` (its sequences),
`cell.interfaces.plugin.plugin` (what a host program loads) and `cell.interfaces.cli` (the command
line). What the commands do is in `cell.jobs`.
"""

from importlib.util import find_spec
from pathlib import Path

_NEIGHBOURS = ("gripper", "tactile", "motion", "recognition", "simulator")
"""Packages that are installed beside this one, at the top level."""


def _refuse_shadows() -> None:
    """Raise ImportError if another module hides one of the packages that belong to this one.

    They have plain names: a host's own ``gripper.py`` that comes earlier on ``sys.path`` would be
    imported instead, and fail with "'gripper' is not a package".
    """
    home = Path(__file__).resolve().parents[1]
    for name in _NEIGHBOURS:
        spec = find_spec(name)
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if found is not None and found != home / name / "__init__.py":
            raise ImportError(
                f"{found} hides the package {name!r} of tactile-cell, which is in {home}: both are "
                f"called {name!r} and the other one comes first on sys.path; rename it, or start "
                "the program where it is not found first"
            )


_refuse_shadows()
