"""How far the grasps of one object repeat each other: learnt from grasps held out of teaching."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

from recognition.recognizer import DEPENDENCE

FLATTENING = 0.005
"""Share of the uniform distribution that each grasp gets before it is fused."""
_RUN_LENGTHS = (2, 3)
_PRIOR_SPREAD = 0.25


def evidence(probability: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the logarithm of flattened probabilities over the uniform ones, (n, C) for (n, C)."""
    n_labels = probability.shape[1]
    flattened = (1.0 - FLATTENING) * probability + FLATTENING / n_labels
    told: NDArray[np.float64] = np.log(flattened * n_labels)
    return told


def independent_share(n_grasps: int, dependence: float) -> float:
    """Return what each of n grasps counts: together they weigh n / (1 + (n - 1) dependence)."""
    return 1.0 / (1.0 + (n_grasps - 1) * dependence)


def fit_dependence(
    probability: NDArray[np.float64], classes: NDArray[np.int64], run: NDArray[np.int64]
) -> float:
    """Return the dependence under which fused grasps are likeliest to name their object.

    Runs of two and three grasps are fused as `recognition.fusion.fuse` does. Where they say little,
    because they are few or sure anyway, the answer stays near `DEPENDENCE`.

    Parameters
    ----------
    probability : (n, C)
        What each grasp told, from fits that had not seen it; rows of a class in the order of time.
    classes : (n,)
        What each grasp held.
    run : (n,)
        Grasps of one class with the same number follow each other and were held out together.
    """
    told = evidence(probability)
    sums: list[tuple[int, NDArray[np.float64], NDArray[np.int64]]] = []
    for length in _RUN_LENGTHS:
        first = np.arange(len(classes) - length + 1)
        last = first + length - 1
        whole = first[(classes[first] == classes[last]) & (run[first] == run[last])]
        if len(whole):
            total = sum((told[whole + i] for i in range(1, length)), told[whole])
            sums.append((length, total, classes[whole]))

    def loss(dependence: float) -> float:
        value = 0.5 * ((dependence - DEPENDENCE) / _PRIOR_SPREAD) ** 2
        for length, total, truth in sums:
            p = log_softmax(independent_share(length, dependence) * total, axis=1)
            # Windows overlap: each grasp stands in as many as a window is long.
            value -= float(p[np.arange(len(truth)), truth].sum()) / length
        return float(value)

    found = minimize_scalar(loss, bounds=(0.0, 1.0), method="bounded")
    return float(found.x)
