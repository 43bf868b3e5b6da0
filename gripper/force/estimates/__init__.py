"""Estimates of a grip: its force, the stiffness of the part, the friction of the gearing."""
