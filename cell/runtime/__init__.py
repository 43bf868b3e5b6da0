"""One cell: the thread that owns it, its jobs, and the work of each task.

A host loads it through the entry point `tactile_cell` of `robot_cell.plugins`; the service and the
commands that grasp use it too. `plugin`: the class `TactileCellPlugin`. `goals`: requests and their
checks. `tasks`: the work of each job. `worker`: the thread. `lease`: the right to command.
"""
