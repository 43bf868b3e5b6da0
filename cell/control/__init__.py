"""One cell at work: states, grasps, sequences, and what is decided and recorded on the way.

For jobs and interfaces: `controller.CellController` (what may be commanded), `states` (the one
table of states), `plan` (poses and steps of a sequence), `identification` (grasp until sure),
`positioner` (what brings the object or the gripper to a pose).
"""
