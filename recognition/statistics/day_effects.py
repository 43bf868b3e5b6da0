"""Day effects: what all values of a day have in common, beside what belongs to the objects."""

import numpy as np
from numpy.typing import NDArray


def day_effects(mean: NDArray[np.float64], n: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the effect of each of D days, (D,) float64 with the mean 0, by least squares.

    Parameters
    ----------
    mean : (D, L)
        Mean value of each object on each day; any number where there is none.
    n : (D, L)
        Number of values; each day has some.
    """
    day, label = np.nonzero(n)
    weight = np.sqrt(n[day, label])
    design = np.concatenate([np.eye(len(n))[day], np.eye(n.shape[1])[label]], axis=1)
    effects = np.linalg.lstsq(design * weight[:, None], mean[day, label] * weight)[0][: len(n)]
    return np.asarray(effects - effects.mean(), dtype=np.float64)
