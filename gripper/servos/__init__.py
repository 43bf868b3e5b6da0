"""The servos of one gripper as a group: feedback, goals with their limits, health, verification.

For the gripper and its force loop: `group.Servos` (read, write goals, stop, torque and
watchdog) and `health.ServoHealth` (checks and verification). Limits of current, force and position
stand in `goals`, beside the one write of goals to the bus. Inside: `feedback`, `stop_goals`,
`verification` (requirements of registers), `watchdog_proof` (self-test of the bus watchdog).
"""
