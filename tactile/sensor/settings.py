"""Settings of the sensor: mean, limits of a zero, limits of valid samples."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSettings:
    """Settings of the conversion from frames to forces; shares are of the full scale.

    The defaults suit 50 frames/s and one-sided noise of up to 8 % of the full scale on each taxel
    and frame; the thresholds follow the noise of the tare.
    """

    mean_frames: int = 3
    """Number of averaged frames: the force then follows a step completely."""
    noise_share: float = 0.002
    """Least noise of a taxel."""
    # Zero
    rest_share: float = 0.12
    """Largest mean of a healthy taxel without a touch: above it is pressed or defective."""
    bump_share: float = 0.016
    """Largest excess of a region over its pad's median, smoothed over 3 x 3 taxels."""
    pad_share: float = 0.016
    """Largest excess of a gripping pad's median over that of the other pads: more is a large object
    that presses evenly. Not checked if a layout has no other pads."""
    moved_share: float = 0.024
    """Largest difference of a region between the first and the second half of a tare's frames."""
    bad_share: float = 0.05
    """Largest share of bad taxels of a pad with a zero, and with valid forces. One bad taxel is
    always allowed, unless the share is 0."""
    # Samples
    frozen_s: float = 0.08
    """Longest time in s of identical samples, if the zero has noise."""
    stuck_frames: int = 25
    """Number of equal samples of a bad taxel, while others change."""
    force_step_n: float = 1.0
    width_step_m: float = 5e-4
    """Without noise: changes of the set-point in N, or of the opening in m with touched pads, after
    which identical samples are frozen ones."""
    drift_share: float = 0.01
    """Largest distance of the untouched pads from their zero."""
