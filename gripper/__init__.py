"""A force-controlled two-finger gripper on DYNAMIXEL X servos; no taxels, no objects.

For a program that moves a gripper: `gripper.gripper.Gripper` with
`gripper.settings.GripperSettings`; the values that it returns are in `gripper.state`, the
mechanics in `gripper.kinematics`, the errors in `gripper.errors`. Chapters: `force` (ramps and
the force loop), `servos` (the servos of one gripper as a group), `dynamixel` (Protocol 2.0 on a
serial line; the only importer of `serial` and the SDK).
"""
