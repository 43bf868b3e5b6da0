"""Control of the grip force: from set-point and feedback to the goals of the servos.

`grip_control` runs one period and converts the driving force to goals. `law` makes this force, with
the estimates of `observer`.
"""
