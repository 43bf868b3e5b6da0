"""Object recognition by touch: from the record of a grasp to probabilities of the objects.

A recognizer makes a `Posterior` from a `Grasp`. `make_trainer` finds trainers by name, `fuse` joins
several grasps of one object. Sub-packages: `ramp` reduces a grasp to levels of load, and `features`
describes these. `statistics` classifies and fuses grasps, and `recognizers` has the kinds of
recognizer. `drift` corrects for changed sensors, and `evaluation` computes figures. `quadric` is
the paper's method, `shape` fits shape and size. The package uses no file, clock, thread or bus.
"""

import lazy_loader

# The names stand in __init__.pyi. A module is imported at the first use of one of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
