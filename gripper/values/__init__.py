"""Values of the gripper: its reports, measurements and results.

`state` is the feedback of servos and gripper, and one period of the loop. `force_sensor` is a force
sample, its source, and the newest samples. `outcome` is the end of a command, `servo_checks` the
result of checks of the servos.
"""
