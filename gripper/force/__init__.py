"""Force ramps and the force loop: set-point in, goal current out, every period.

`loop` runs the periods, `ramp` is the set-point, `grasp` runs one grasp: `approach` closes empty
fingers until the pads show a contact, `control` makes the force, `supervision` decides whether the
part is there and holds still. `estimates` has the estimated state of a grip, `certainty` the limits
that all decisions share. `load_trial` moves one finger against the other to measure the drives.
`timing` counts lateness and overruns.

A constant names its source at its end. *Tuned*: in the simulated cell, with friction errors up to
20 %. *Chosen*: by the needs of a person or program. *Assumed*: without data. *Resolution*: of a
register. *Statistics*: of noise. *Log*: of a real servo. *Simulated*: computed in the simulated
cell. *Vendor*: a manual. Derived constants have no source.
"""
