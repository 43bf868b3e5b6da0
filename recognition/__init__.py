"""Object recognition by touch: from the record of a grasp to probabilities of what was held.

A `recognition.grasp.Grasp` goes in, a `recognition.recognizer.Posterior` comes out; recognisers and
their trainers are found by name in `recognition.recognizers`. `ramp` reduces a grasp to levels of
load, `features` describes these, `statistics` classifies, fuses grasps and chooses the next one,
`drift` corrects for changed sensors, `evaluation` gives figures. `quadric` is the paper's method,
`shape` fits shape and size. No file, clock, thread or bus is used: numbers in, numbers out.
"""
