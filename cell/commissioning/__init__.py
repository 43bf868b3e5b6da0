"""Commissioning: a cell brought up from the box to its first grasp, step by step.

`engine` runs the steps and keeps their findings in commissioning.json; the terminal is its
`Dialog`. Each file has the steps of one subject. They work on a `bench`: the ports of the cell and
the config so far. `doctor` is the system check, `servo_bench` measures one servo.
"""
