"""The robot cell: puts gripper, tactile sensor, recognizer and positioner together.

The composition root and the only package that imports all others. `build_cell` makes a cell from a
config, `CellController` runs its sequences, a host program loads `TactileCellPlugin`.
`cell.interfaces` has the command line and the interfaces, `cell.runtime` the jobs of a cell.
"""

import lazy_loader

# The names stand in __init__.pyi. A module is imported at the first use of one of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
