"""The robot cell: puts gripper, tactile sensor, recogniser and positioner together.

The composition root and the only package that imports all others. `build_cell` makes a cell from a
config, `CellController` runs its sequences, a host program loads `TactileCellPlugin`.
`cell.interfaces` has the command line and the interfaces, `cell.jobs` the jobs of the commands.
"""

from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cell.build import Cell as Cell, build_cell as build_cell
    from cell.config.file import load_config as load_config
    from cell.config.model import CellConfig as CellConfig
    from cell.control.controller import CellController as CellController
    from cell.errors import CellError as CellError
    from cell.plugin.plugin import TactileCellPlugin as TactileCellPlugin

_FACE = {
    "cell.build": "Cell build_cell",
    "cell.config.file": "load_config",
    "cell.config.model": "CellConfig",
    "cell.control.controller": "CellController",
    "cell.errors": "CellError",
    "cell.plugin.plugin": "TactileCellPlugin",
}
"""Names by module, which is imported when one of them is first used."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

_NEIGHBOURS = ("gripper", "tactile", "motion", "recognition", "simulator")
"""Packages that are installed beside this one, at the top level."""


def _refuse_shadows() -> None:
    """Raise ImportError if another module hides a package of this project.

    They have plain names: a host's own ``gripper.py`` earlier on ``sys.path`` would be imported
    instead, and fail with "'gripper' is not a package".
    """
    home = Path(__file__).resolve().parents[1]
    for name in _NEIGHBOURS:
        spec = find_spec(name)
        found = None if spec is None or spec.origin is None else Path(spec.origin).resolve()
        if found is not None and found != home / name / "__init__.py":
            raise ImportError(
                f"{found} hides the package {name!r} of tactile-cell in {home}: it comes first on "
                "sys.path; rename it, or start the program in another folder"
            )


_refuse_shadows()

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
