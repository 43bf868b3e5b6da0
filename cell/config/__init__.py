"""The config file: all settings with units, ranges and defaults; YAML in and out.

For all that runs a cell: `model.CellConfig` is the root, `file` reads and writes YAML with errors
by line, `gripper`, `tactile`, `sequence` and `simulator` are its sections.
"""
