"""Commissioning: a cell brought up from the box to its first grasp, step by step.

`engine` runs the steps and keeps what they found in commissioning.json; a face (terminal, page)
is its `Dialog`. The steps stand one subject a file, and work on a `bench`: the ports of the cell
and the config so far.
"""
