"""Shape and size of a pressed object: surfaces fitted in a model of the foam, with intervals.

`answer` is the entry. It reduces a grasp to pressed pads, fits all kinds of shape under all
possible foams (`fit`, `residuals`, `models`, `foam`), and weights them. `fusion` joins
several grasps of one object. Constants without another source were chosen on simulated and
recorded pads (docs/explanations/shape-and-size.md).
"""
