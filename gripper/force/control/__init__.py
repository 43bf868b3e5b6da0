"""Control of the grip force: from set-point and feedback to the goals of the servos.

`grip_control` runs one period. `law` makes the driving force, with the estimates of `observer`.
`drive_goals` converts the driving force to goals.
"""
