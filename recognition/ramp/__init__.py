"""Ramp of a grasp: rest, touch and load of the taxels, levels of load, and the load so far."""
