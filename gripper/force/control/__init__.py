"""Control of the grip force: from set-point and feedback to the goals of the servos.

`grip_control` runs one period. `modes` holds the three laws and the table of their transitions:
`band_mode` (slow changes and holds), `motion_mode` (fast changes and corrections as a planned
motion), and a wait where no sample can be used. `drive_goals`
makes goals of the driving force.
"""
