"""Features of a grasp: one table of groups (`groups`), each a function of the ramp's levels."""
