"""Day effects: what all values of a day have in common, beside what belongs to the objects."""

import numpy as np
from numpy.typing import NDArray

_ROUNDS = 50
"""Rounds in which effects of objects and days are found in turn."""


def day_effects(mean: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the effect of each of D days, (D,) float64 with the mean 0, by least squares.

    Parameters
    ----------
    mean : (D, L)
        Mean value of each object on each day; any number where there is none.
    n : (D, L)
        Number of values; each day has some.
    """
    effect = np.zeros(len(mean))
    per_object = np.maximum(n.sum(axis=0), 1.0)
    for _ in range(_ROUNDS):
        objects = (n * (mean - effect[:, None])).sum(axis=0) / per_object
        effect = (n * (mean - objects)).sum(axis=1) / n.sum(axis=1)
        effect -= effect.mean()
    return np.asarray(effect, dtype=np.float64)
