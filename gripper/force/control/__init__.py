"""Control of the grip force: from set-point and feedback to the goals of the servos.

`grip_control` runs one period. `modes` has the three laws and the table of their transitions:
`band_mode` (holds, falls, frames), `motion_mode` (rises and corrections with messages as a planned
motion), and a wait without a usable sample. `drive_goals` converts the driving force to goals.
"""
