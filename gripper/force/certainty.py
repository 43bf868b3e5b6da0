"""Certainty of decisions in the force loop: how far, and how long, a measurement must differ.

The detectors share these limits, so that a change of one changes all decisions of its kind.
"""

from gripper.values.force_sensor import FRAME_S

SURE_SDS = 3.0
"""Standard deviations of a difference that is no noise. The next samples correct a wrong decision.
[statistics]"""
PRESENT_SHARE = 0.5
"""Share of an expected force above which it counts as present. [chosen]"""
EMPTY_SHARE = 0.25
"""Share of ``contact_force_n`` below which a pad is empty. [tuned]"""
REACHED_SHARE = 0.8
"""Share of a nominal speed or current above which it counts as reached. Below 1 minus this
share the fingers stand. [chosen]"""
YOUNG_S = 0.75 * FRAME_S
"""Time in s that is less than a frame takes: newer samples are force messages."""
BRIEF_S = 5 * FRAME_S
"""Time in s of five frames: what is shorter decides nothing."""
STEADY_S = 15 * FRAME_S
"""Time in s in which force and fingers come to rest with any part. A contradiction that lasts
longer is a fault."""
STALLED_S = 25 * FRAME_S
"""Time in s after which fingers that stand under their current will not move any more."""
RECOVERED_S = 2.0 * STALLED_S
"""Time in s after which foam presses a part hardly more than before."""
RUN_STEPS = 3.0
"""Travel in steps of the opening, the counts of its servos, that is a motion. [resolution]"""
