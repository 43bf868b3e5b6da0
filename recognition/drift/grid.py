"""Grid of drifts: hypotheses of gain and opening since teaching, each with its weight."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class DriftPrior:
    """What is known of the drift since teaching before any object is grasped.

    The default stands for another day. Two self-zeros, at teaching and today, narrow it.

    Raises
    ------
    ValueError
        A value is outside of its range.
    """

    log_gain: float = 0.0
    log_gain_sd: float = 0.25
    """Mean and standard deviation of the logarithm of the gain that all pads have in common."""
    offset_mm: float = 0.0
    offset_sd_mm: float = 3.0
    """Mean and standard deviation of how much more the opening reads than at teaching, in mm."""
    unchanged: float = 0.5
    """Probability from 0 to 1 that gain and opening are exactly as they were taught."""

    def __post_init__(self) -> None:
        if not (0.0 < self.log_gain_sd <= 1.0 and 0.0 < self.offset_sd_mm <= 30.0):
            raise ValueError(
                f"deviations of the drift are {self.log_gain_sd} and {self.offset_sd_mm} mm, "
                "must be above 0 and at most 1 and 30 mm"
            )
        if not (abs(self.log_gain) <= 1.0 and abs(self.offset_mm) <= 50.0):
            raise ValueError(
                f"means of the drift are {self.log_gain} and {self.offset_mm} mm, "
                "must be within 1 and 50 mm of 0"
            )
        if not 0.0 <= self.unchanged <= 1.0:
            raise ValueError(f"unchanged is {self.unchanged}, must be from 0 to 1")
