"""The robot cell: puts gripper, tactile sensor, recogniser and positioner together.

The composition root and the only package that imports all others. `build_cell` makes a cell from a
config, `CellController` runs its sequences, a host program loads `TactileCellPlugin`.
`cell.interfaces` has the command line and the interfaces, `cell.jobs` the jobs of the commands.
"""

from importlib import import_module
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

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
