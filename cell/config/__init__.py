"""The config file: all settings with units, ranges and defaults; YAML in and out.

`model.CellConfig` is the root, `file` reads and writes YAML with errors by line, `gripper`,
`tactile`, `sequence`, `simulator` and others are its sections.
"""
