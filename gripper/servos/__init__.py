"""The servos of one gripper as a group: feedback, goals with their limits, health, verification.

For the gripper and its force loop: `group.Servos` (read, write and stop goals, torque, watchdog,
checks and verification). Limits of current, force and position stand in `goal_limits`, beside the
one write of goals to the bus. `bus_loss` counts the periods without feedback. Inside: `feedback`
with `motion` (speed) and `winding` (current and heat); `verification` (requirements of registers),
`watchdog_proof` (self-test of the bus watchdog).
"""
