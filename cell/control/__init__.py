"""One cell at work: its states, grasps, sequences, decisions and records.

For jobs and interfaces: `controller.CellController` has the commands, `states` the one table of
states. `plan` has the poses and steps of a sequence, `identification` grasps until sure, and
`positioner` moves the object or the gripper to a pose.
"""
