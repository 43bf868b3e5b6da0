"""Settings of a view, for its teaching and its answers."""

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewSettings:
    """Each with unit and purpose, and its source in brackets.

    Sources: "6" is decision 6 (docs/decisions), "taught part" the part of recorded grasps that
    teaches, "time" a bound on the time of a teaching.
    """

    # Scores
    freedom: float = 3.0
    """Degrees of freedom of the t distribution of a grasp about its object: heavy tails [6]."""
    outside_power: float = 0.85
    """Power of the spread beside many classes in the unit of distances [taught part: .75 to 1]."""
    outside_axes: float = 3.0
    """Axes between the classes at which half of that power is reached [taught part]."""
    least_distance: float = 0.1
    """Added to squared distances before their logarithm: a lower limit of novelty [taught part]."""
    # Discriminant
    touch_shrinkage: float = 0.2
    """Least share of the target in the covariance by touch alone [taught part]."""
    opening_target: float = 0.1
    """Variance of the opening's features in the target, over that of the touch features [6]."""
    least_unit: float = 0.02
    """Deviation added to that of each feature, in its unit (log, root of share, mm) [6]."""
    most_axes: int = 64
    """Most axes between the classes, those that separate best [time, and the size of a model]."""
    # Many objects
    likely: int = 256
    """Number of classes in an answer: those nearest under any drift [time]."""
    taught: int = 20_000
    """About the most taught grasps to compare a new one with [time, and size]."""
    # Drifts
    log_gain_unit: float = 0.1
    """Unit of drifts of a pad's gain (log), relative to the other pads [taught part]."""
    offset_unit_mm: float = 1.0
    """Unit of drifts of the opening in mm [taught part]."""
    nuisance: float = 0.15
    """Drift, in units, that the discriminant ignores: the remainder between grid steps [6]."""
    made_up: float = 0.5
    """Standard deviation, in units, of simulated drifts of held-out grasps [taught part]."""
    slope_offset_mm: float = 0.5
    """Step of the opening in mm for slopes of features, a step of the grid; of gains a unit [6]."""
    slope_grasps: int = 100
    """About the number of grasps for the mean change of features by a drift [time]."""
    # Held-out grasps
    blocks: int = 3
    """Blocks in time, held out in turn: few and large, because grasps in use are far in time [6].
    """
    held_grasps: int = 2000
    """Most grasps of all blocks for temperature and limits [time]."""
    parts: int = 4
    """Parts of each block, each with its own simulated drift [time]."""
    # Novelty
    novelty_slope: float = 2.0
    """Log odds of a new object for each unit of the novelty [taught part]."""
    known_share: float = 0.97
    """Share of held-out grasps below the limit of novelty [6]."""
    usual_novelty: float = 3.0
    """Expected mean novelty of held-out grasps, without the size [6]."""
    usual_beyond: tuple[float, float] = (0.8, 1.9)
    """Limits without and with the size, above that mean and one sd of log chi2 [6]."""
    prior_grasps: float = 100.0
    """Weight of these expectations, in grasps [6]."""
    new_quantile: float = 0.05
    """Share of held-out grasps less likely of a taught object than of a new one [taught part]."""
    # Opening on another day
    placing: float = 2.5
    """Spread of the opening between placings of other days, over that of a series [taught part]."""
    least_placing_mm: float = 0.3
    """Least spread of the opening between placings in mm [taught part]."""
    even_grasps: int = 150
    """About the number of held-out grasps for the certainty of names on other days [time]."""
    even_days: int = 8
    """Simulated days of each of them [time]."""
    wrong: float = 0.03
    """Largest share of wrong names among them; below 5 %, because the foam is the same [6]."""


SETTINGS: Final = ViewSettings()
"""Those of all views."""
