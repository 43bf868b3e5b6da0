"""Novelty detector: probability that an object was never taught, fitted on left-out objects."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import expit

KNOWN_KEPT = 0.97
"""Share of grasps of taught objects that are to have ``unknown`` below 0.5."""
FEWER_KEPT = 0.4
"""Taken off that share among held-out grasps, over the number of grasps of an object: the whole
teaching leaves fewer grasps far off than its parts do, the more so the fewer there are. Chosen with
three to ten grasps of two to thirty recorded objects."""

_LOG_SLOPES = (-2.0, 3.0)
"""Range of the logarithm of the slope that is searched."""
_SINGLE_SLOPE = 2.0
"""Log odds for each unit of the novelty, where no object can be left out."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NoveltyDetector:
    """Logistic curve from the novelty of a grasp to the probability that its object is new.

    The novelty is the logarithm of a squared distance to the nearest class, with that of the size.
    """

    slope: float
    """Log odds for each unit of the novelty."""
    even: float
    """Novelty with even odds; up to ``KNOWN_KEPT`` of held-out grasps of taught objects lie below.
    """

    def probability(
        self, novelty: NDArray[np.float64], *, caution: float = 1.0
    ) -> NDArray[np.float64]:
        """Return (n,) probabilities that the object was never taught.

        The odds are multiplied by ``caution``, above 0.
        """
        odds = self.slope * (novelty - self.even) + np.log(caution)
        return np.asarray(expit(odds), dtype=np.float64)

    def to_arrays(self, prefix: str) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays under names that begin with the prefix."""
        return {f"{prefix}slope": np.array(self.slope), f"{prefix}even": np.array(self.even)}

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]], prefix: str) -> Self:
        """Rebuild from `to_arrays`; KeyError where an array is missing."""
        return cls(slope=float(arrays[f"{prefix}slope"]), even=float(arrays[f"{prefix}even"]))


def held_out_kept(n_grasps: NDArray[np.int64]) -> float:
    """Return the share of held-out grasps of taught objects that lie below the even odds.

    ``n_grasps`` (C,) are the taught grasps of each object.
    """
    return KNOWN_KEPT - FEWER_KEPT * float(np.mean(1.0 / n_grasps))


def fit_novelty_detector(
    known: NDArray[np.float64], left_out: NDArray[np.float64], even: float
) -> NoveltyDetector:
    """Fit the detector on grasps of taught objects and of objects left out of teaching.

    Parameters
    ----------
    known, left_out : (n,)
        Novelty of both kinds, from the same fits. With none of either the slope is a fixed one.
    even
        Novelty with even odds.
    """
    if not (len(known) and len(left_out)):
        return NoveltyDetector(slope=_SINGLE_SLOPE, even=even)

    def loss(log_slope: float) -> float:
        # Both kinds count alike, however many there are of each.
        slope = float(np.exp(log_slope))
        return float(
            np.logaddexp(0.0, slope * (known - even)).mean()
            + np.logaddexp(0.0, -slope * (left_out - even)).mean()
        )

    found = minimize_scalar(loss, bounds=_LOG_SLOPES, method="bounded")
    return NoveltyDetector(slope=float(np.exp(found.x)), even=even)
