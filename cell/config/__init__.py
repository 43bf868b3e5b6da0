"""The config file: all settings with units, ranges and defaults; YAML in and out.

`model.CellConfig` is the root, `file` reads and writes YAML with errors by line, `gripper`,
`tactile`, `sequence`, `simulator` and others are its sections.

Each way to a cell imports this package first, so it refuses modules that hide packages.
"""

from cell.installation import refuse_shadows

refuse_shadows()
