"""Values of the gripper: its reports, measurements and results; frozen, without behaviour.

`state` is the feedback of servos and gripper and one period of the loop, `force_sensor` a force
sample and who gives it, `recent` the newest samples, `outcome` the end of a command, `servo_checks`
what checks of the servos find.
"""
