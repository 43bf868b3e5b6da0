"""One cell at work: its states, grasps, sequences, decisions and records.

For jobs and interfaces: `controller.CellController` (the commands), `states` (the one table of
states), `plan` (poses and steps of a sequence), `identification` (grasp until sure),
`positioner` (moves the object or the gripper to a pose).
"""
