"""The robot cell: puts gripper, tactile sensor, recogniser and positioner together.

The composition root and the only package that imports all others. Start at `cell.build.build_cell`
(a cell from a config), `cell.controller.CellController` (its sequences), `cell.plugin` (what a host
program loads) and `cell.cli` (the command line). What the commands do is in `cell.jobs`.
"""
