"""Mechanics between servos and fingers.

`kinematics`: angle, opening and torque. `transmission`: current and grip force. `impact`: the
closing speed that the force cap allows. `identification`: the drive of a servo by its motion.
"""
