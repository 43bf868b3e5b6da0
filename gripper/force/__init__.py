"""Force ramps and the force loop: set-point in, goal current out, every period.

For the gripper: `loop` runs the periods, `ramp` is the set-point, `free_motion` moves empty
fingers, `approach` closes them until `contact`, `grasp` runs one grasp from approach to hold.
Inside: `grip_control` (goals of one period, stiffness and friction estimates), `controller` (force
controller and set-point filter), `slip`, `timing` (lateness and overruns).
"""
