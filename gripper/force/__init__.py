"""Force ramps and the force loop: set-point in, goal current out, every period.

`loop` runs the periods, `ramp` is the set-point, `grasp` runs one grasp: `approach` closes empty
fingers until the pads show a contact, `control` makes the force, `supervision` decides whether the
part is there and holds still. `estimates` has the estimated state of a grip, `timing` counts
lateness and overruns.

A constant names its source at its end. *Tuned*: in the simulated cell, with friction errors up to
20 %. *Chosen*: by the needs of a person or program. *Assumed*: without data. *Resolution*: of a
register. *Statistics*: of noise. *Vendor*: a manual. Derived constants have no source.
"""
