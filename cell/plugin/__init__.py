"""The application core: the cell behind jobs that never block.

A host loads it through the entry point `tactile_cell` of `robot_cell.plugins`. The service uses it
too. `plugin`: the class `TactileCellPlugin`. `goals`: requests and their checks. `answer`: results.
`tasks`: the work of each job. `worker`: the thread of a cell. `lease`: the right to command.
"""
