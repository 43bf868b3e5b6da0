"""Force ramps and the force loop: set-point in, goal current out, every period.

For the gripper: `loop` runs the periods, `ramp` is the set-point, `free_motion` moves empty
fingers, `approach` closes them until `contact`, `grasp` runs one grasp from approach to hold.
Inside: `control` (the laws of force and their table), `estimates` (force, stiffness, friction),
`supervision` (is the part there, does it slip), `timing` (lateness and overruns).
"""
