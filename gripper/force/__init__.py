"""Force ramps and the force loop: set-point in, goal current out, every period.

`loop` runs the periods, `ramp` is the set-point, `grasp` runs one grasp: `approach` closes empty
fingers until the pads show a contact, `control` makes the force, `supervision` decides whether the
part is there and holds still. `estimates` are what is known of a grip, `by_current` is a force
sensor without pads, `timing` counts lateness and overruns.

A figure names its source at its end. It is *tuned* in the simulated cell, with friction up to 20 %
off, *chosen* by what a person or program needs, *assumed* without data, from the *resolution* of a
register, from *statistics* of noise, or from the *vendor*. What follows from others has none.
"""
