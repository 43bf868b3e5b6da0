"""Grasps of objects that nobody named -> what drifted since teaching.

One cell has one drift, so the grasps of a shift show it together even where each leaves it open.
What one object can say is bounded: a drift that explains it may as well be a new object, and only
several different objects that agree make a drift likelier than none.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift import DriftGrid

_MOST_PER_OBJECT = 6.0
"""Logarithm of the most that one object may speak for one drift and against another."""
_CHANGE = 1e-4
"""Share of the probability that is kept for any drift at all, so that a later one is found too."""


def follow(
    grid: DriftGrid, log_likelihood: NDArray[np.float64], bias: NDArray[np.float64]
) -> DriftGrid:
    """Return what the drift may be after some grasps of one object.

    Parameters
    ----------
    grid
        What it may be before.
    log_likelihood : (n, G, O) or (n, G, 1)
        Of each grasp under each drift of the grid, whatever was held. Together they count like one.
    bias : (G, O) or (G, 1)
        Its mean in grasps without drift: a drift that those prefer to none is not believed more.
    """
    middle = tuple(length // 2 for length in bias.shape)
    told = log_likelihood.mean(axis=0) - np.maximum(bias - bias[middle], 0.0)
    told = np.maximum(told - told.max(), -_MOST_PER_OBJECT)
    after = grid.log_prior + told
    after = after - logsumexp(after)
    kept = np.logaddexp(after + np.log1p(-_CHANGE), np.log(_CHANGE / after.size))
    return replace(grid, log_prior=np.asarray(kept, dtype=np.float64))
